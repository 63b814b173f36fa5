"""Find the nodes that stay in float32 when a graph becomes float16, and why."""

import fnmatch
import itertools
from collections.abc import Collection, Iterable, Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.stream import Recording
from me2e_compress.graph import is_standard, provenance, static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, Numbers, constant_values
from me2e_compress.passes.convert_float16.element_types import ElementTypes
from me2e_compress.quantization.geometry import position_arithmetic
from me2e_compress.runtime.providers import CPU, Provider

LARGEST = float(np.finfo(np.float16).max)
"""65504."""

HEADROOM = 2.0
"""Factor by which other frames may exceed the measured range."""

LONGEST_SUM = 1024
"""A half has 11 bits: a sum of more than 2,048 equal numbers stops growing. A kernel
that adds up a softmax in half is right to 1e-3 up to half of that."""

_RESOLUTION = 2.0**-10
"""Relative error of a constant that still is the same constant."""

_SUMS = frozenset(
    {
        "CumSum", "Exp", "Log", "Mean", "MeanVarianceNormalization", "Pow", "ReduceL1",
        "ReduceL2", "ReduceLogSum", "ReduceLogSumExp", "ReduceMean", "ReduceProd",
        "ReduceSum", "ReduceSumSquare", "Softplus", "Sum",
    }
)  # fmt: skip
"""Sums of many elements, squares and exponentials: they leave float16 on their way."""

_CHOICES = frozenset(
    {
        "ArgMax", "ArgMin", "Equal", "Greater", "GreaterOrEqual", "Less", "LessOrEqual",
        "NonMaxSuppression", "NonZero", "TopK", "Ceil", "Floor", "Round",
    }
)  # fmt: skip
"""Operators that choose between numbers: nearly equal ones would become equal."""

_PLACES = frozenset({"DeformConv", "Det", "GridSample", "Range", "RoiAlign"})
"""Operators that take coordinates beside their data."""

_MOVES = LAYOUT_OPERATORS | {
    "Concat", "Expand", "Gather", "GatherElements", "GatherND", "Pad",
    "ScatterElements", "ScatterND", "Slice", "Split", "Tile",
}  # fmt: skip
"""What only moves elements: it is as exact in either type."""


def wide_nodes(
    model: ir.Model,
    types: ElementTypes,
    frames: Recording | None,
    *,
    keep_io: bool,
    provider: Provider = CPU,
) -> dict[ir.Node, str]:
    """Map the nodes of the main graph that must stay in float32 to the reason.

    Shapes and types must be inferred; without ``frames`` no ranges are measured.
    """
    # Operators, constants and positions decide without running the graph
    places = position_arithmetic(model, constant_values(model))
    found: dict[ir.Node, str] = {}
    for node in model.graph:
        reason = _by_operator(node) or _by_constants(node, types)
        if reason is None and node in places:
            reason = "positions: a half is right to 1/2048"
        if reason is not None:
            found[node] = reason
    # Measured ranges and the nodes in between come last
    if frames is not None:
        found |= _by_ranges(model, types, found, frames, provider)
    return found | _between(model, found, keep_io=keep_io)


def matching(
    model: ir.Model,
    ops: Collection[str],
    modules: Collection[str],
    globs: Iterable[str],
) -> dict[ir.Node, str]:
    """Map the nodes that the user keeps in float32 to the reason."""
    patterns = tuple(globs)
    return {
        node: "the options keep it"
        for node in model.graph
        if node.op_type in ops
        or provenance.module_of(node) in modules
        or any(fnmatch.fnmatchcase(node.name or "", glob) for glob in patterns)
    }


def _by_operator(node: ir.Node) -> str | None:
    if not is_standard(node):
        return "not an operator of ONNX"
    if graph.has_subgraph(node):
        return "has a body"
    if node.op_type in _SUMS:
        return "sums, squares and exponentials"
    if node.op_type in _CHOICES:
        return "choices between nearly equal numbers"
    if node.op_type in _PLACES:
        return "positions: a half is right to 1/2048"
    if node.op_type in ("LogSoftmax", "Softmax"):
        shape = static_shape(node.inputs[0])
        axis = node.attributes.get_int("axis", -1)
        if shape is None or shape[axis] > LONGEST_SUM:
            return f"a softmax over more than {LONGEST_SUM} elements"
    return None


def _by_constants(node: ir.Node, types: ElementTypes) -> str | None:
    for index in types.inputs(node):
        value = node.inputs[index]  # the default of an input counts as well
        tensor = None if value is None else ir.convenience.get_const_tensor(value)
        if tensor is not None and not _fits(tensor.numpy().astype(np.float64)):
            return "a constant that float16 does not hold"
    return None


def _fits(numbers: Numbers) -> bool:
    """Return whether constants are the same in float16.

    Of more than 16 numbers only the large ones count: the rest may become 0.
    """
    size = np.abs(numbers)
    if numbers.size == 0 or not np.isfinite(size).all():
        return True
    if size.max() > LARGEST:
        return False
    error = np.abs(numbers.astype(np.float16).astype(np.float64) - numbers)
    scale = size if numbers.size <= 16 else size.max()
    return bool((error <= _RESOLUTION * scale).all())


def _by_ranges(
    model: ir.Model,
    types: ElementTypes,
    known: Collection[ir.Node],
    frames: Recording,
    provider: Provider,
) -> dict[ir.Node, str]:
    # Map the measured values to the nodes that touch them
    touched: dict[str, list[ir.Node]] = {}
    constants = constant_values(model)
    for node in model.graph:
        if node in known:
            continue
        read = [node.inputs[index] for index in types.inputs(node)]
        made = [node.outputs[index] for index in types.outputs(node)]
        for value in (*read, *made):
            if value is not None and value not in constants:
                touched.setdefault(str(value.name), []).append(node)
    if not touched:
        return {}
    calibrator = Calibrator(provider=provider)
    ranges = calibrator.run(model, tuple(touched), frames).tensors
    # Keep a factor of headroom for frames that were not measured
    large = {
        name: max(-low, high)
        for name, (low, high) in ranges.items()
        if max(-low, high) * HEADROOM > LARGEST
    }
    return {
        node: f"numbers up to {reach:.3g}"
        for name, reach in large.items()
        for node in touched[name]
    }


def _between(
    model: ir.Model, wide: Mapping[ir.Node, str], *, keep_io: bool
) -> dict[ir.Node, str]:
    """Find nodes that only move elements between float32 nodes, inputs and outputs."""
    moves = {node: None for node in model.graph if node.op_type in _MOVES}

    def from_wide(node: ir.Node) -> bool:
        data = node.inputs if node.op_type == "Concat" else node.inputs[:1]
        makers = [None if value is None else value.producer() for value in data]
        return all(
            keep_io if each is None else each in wide or each in moves
            for each in makers
        )

    def to_wide(node: ir.Node) -> bool:
        outside = any(value.is_graph_output() for value in node.outputs)
        readers = itertools.chain(*(value.consumers() for value in node.outputs))
        return (keep_io or not outside) and all(
            each in wide or each in moves for each in readers
        )

    # Strike out moves next to float16 nodes until nothing changes
    before = -1
    while len(moves) != before:
        before = len(moves)
        for node in list(moves):
            if not from_wide(node):
                del moves[node]
        for node in reversed(list(moves)):
            if not to_wide(node):
                del moves[node]
    return dict.fromkeys(moves, "moves numbers between nodes in float32")
