"""Find the small encoders of the ego car's own status."""

import math
from collections.abc import Collection, Iterator

import onnx_ir as ir

from me2e_compress.graph import WEIGHTED, static_shape
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.quantization.geometry import MATRICES

MOST_NUMBERS = 64
"""In a status: speed, acceleration, steering, pose, command; ``can_bus`` has 18."""

LEAST_SENSED = 1024
"""Elements of the largest input, where a graph has sensors beside a status."""

LARGEST = 4096
"""Elements of what still is a status, encoded: more is a map that it was added to."""


def find_ego_layers(
    model: ir.Model, constants: Collection[ir.Value]
) -> dict[ir.Node, str]:
    """Map every layer that sees nothing but the ego car's status to its input.

    A status is an input of at most 64 numbers beside a sensor's, neither recurrent nor
    made of matrices: ``can_bus`` [18], a speed, a command. Its encoder are the layers
    that depend on statuses alone, until they meet other data or grow to more than 4,096
    elements.

    One sweep over the graph, which is in topological order. ``constants`` are values
    that no input changes.
    """
    sources = dict(_statuses(model))
    found: dict[ir.Node, str] = {}
    for node in model.graph if sources else ():
        reads = [each for each in node.inputs if each is not None]
        changing = [each for each in reads if each not in constants]
        if not changing or any(each not in sources for each in changing):
            continue
        # its results are a status too, while they are small
        name = sources[changing[0]]
        if node.op_type in WEIGHTED:
            found[node] = name
        if all(_is_small(value) for value in node.outputs):
            sources.update(dict.fromkeys(node.outputs, name))
    return found


def _statuses(model: ir.Model) -> Iterator[tuple[ir.Value, str]]:
    inputs = [
        value
        for value in model.graph.inputs
        if str(value.name) not in model.graph.initializers
    ]
    # a graph without any sensor has no status beside it
    sizes = {value: _elements(value) for value in inputs}
    known = [size for size in sizes.values() if size is not None]
    if None not in sizes.values() and max(known, default=0) < LEAST_SENSED:
        return
    # small inputs that are neither states nor matrices
    recurrent = recurrent_inputs(model)
    for value, size in sizes.items():
        shape = static_shape(value) or ()
        if size is None or size > MOST_NUMBERS or shape[-2:] in MATRICES:
            continue
        if str(value.name) not in recurrent:
            yield value, str(value.name)


def _elements(value: ir.Value) -> int | None:
    shape = static_shape(value)
    return None if shape is None else math.prod(shape)


def _is_small(value: ir.Value) -> bool:
    size = _elements(value)
    return size is not None and size <= LARGEST
