"""Scales that are too small or too large for what an int8 value is made of."""

import dataclasses
from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.graph.nodes import array_of, input_at, reads_of
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session

MOST_CUT = 0.5
"""Share of elements at one end from which an output, or what an int8 value is made of,
is saturated; max-min ranges cut none, and percentiles one in a thousand."""


@dataclasses.dataclass(frozen=True)
class Cause:
    """What keeps an output from moving, in words; empty if nothing was found."""

    words: str = ""
    saturated: bool = False


def cause_of(
    model: ir.Model | None, output: str, feeds: Mapping[str, Array], provider: Provider
) -> Cause:
    """Hold the scales of the last int8 values before an output against one frame."""
    if model is None or not (nodes := _quantizers(model, output)):
        return Cause()
    # run the graph once with what those nodes read as outputs
    probed, wanted = model.clone(), set(nodes.values())
    made = [value for node in probed.graph for value in node.outputs]
    kept = {value.name for value in probed.graph.outputs}
    probed.graph.outputs.extend(v for v in made if v.name in wanted - kept)
    try:
        session = Session(probed, release=True, provider=provider)
        names = sorted(wanted & {str(value.name) for value in made})
        found = {**feeds, **(session.run(feeds, names) if names else {})}
    except (FramesError, GraphError):
        return Cause()
    causes = (
        _cause(node, found[read]) for node, read in nodes.items() if read in found
    )
    return max(causes, key=lambda each: (each.saturated, each.words), default=Cause())


def _cause(node: ir.Node, read: Array) -> Cause:
    """Hold the scale of a QuantizeLinear against what it reads."""
    scale, stored = array_of(node.inputs[1]), array_of(input_at(node, 2))
    zeros = np.zeros(1, np.uint8) if stored is None else stored.reshape(-1)
    if scale is None or scale.size != 1 or zeros.dtype.kind not in "iu":
        return Cause()
    limits, zero = np.iinfo(zeros.dtype.name), int(zeros[0])
    steps = np.asarray(read, np.float64) / float(scale.item())
    off = (steps + zero > limits.max + 0.5) | (steps + zero < limits.min - 0.5)
    if off.mean() >= MOST_CUT:
        words = f"{node.name} cuts {off.mean():.0%} of what it reads"
        return Cause(f"{words}: its scale is too small", True)
    if np.abs(read).max(initial=0.0) > 0 and np.abs(steps).max() <= 0.5:
        words = f"{node.name} rounds all that it reads to zero"
        return Cause(f"{words}: its scale is too large")
    return Cause()


def _quantizers(model: ir.Model, output: str) -> dict[ir.Node, str]:
    """Find the last QuantizeLinear nodes before an output, and what each reads."""
    waiting = [value for value in model.graph.outputs if value.name == output]
    seen, found = set[ir.Node](), dict[ir.Node, str]()
    while waiting:
        node = waiting.pop().producer()
        if node is not None and node not in seen:
            seen.add(node)
            if node.op_type == "QuantizeLinear":
                found[node] = str(next(reads_of(node)).name)
            else:
                waiting += reads_of(node)
    return found
