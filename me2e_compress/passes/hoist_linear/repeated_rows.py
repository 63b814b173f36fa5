"""Compute row-wise operators before rows are repeated.

Given:   Expand(x) -> Add(bias) -> LayerNormalization -> Relu

Result:  x -> Add(bias) -> LayerNormalization -> Relu -> Expand
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import is_standard, rank_of, static_shape
from me2e_compress.graph.activations import value_bytes
from me2e_compress.graph.nodes import integers_at
from me2e_compress.graph.rewrite import is_read, sole_reader
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.row_moves import (
    broadcasts,
    moved_rows,
    without_repeats,
)
from me2e_compress.passes.work import MOVED_BYTES_PER_NODE, item_bytes

UNARY = frozenset(
    {
        *("Abs", "Celu", "Clip", "Cos", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid"),
        *("HardSwish", "Identity", "LeakyRelu", "Log", "Mish", "Neg", "Reciprocal"),
        *("Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh"),
    }
)
"""Operators that map every element by itself."""

BINARY = frozenset({"Add", "Div", "Max", "Min", "Mul", "Pow", "Sub"})
"""Element-wise operators of two operands, which broadcast."""

REDUCTIONS = frozenset(
    {"ReduceL2", "ReduceMax", "ReduceMean", "ReduceMin", "ReduceSum"}
)
"""Operators that reduce every row to one number where their axis is the last."""

ALONG_AXIS = frozenset({"LayerNormalization", "LogSoftmax", "Softmax"})
"""Operators that map every row by itself where their axis is the last."""

SOFTMAX_OPSET = 13
"""Before, the axis of a softmax was the second by default."""

LONGEST = 16
"""Largest number of nodes between the repeated value and its reader."""


@dataclasses.dataclass(frozen=True)
class Repetition:
    """A value whose rows are repeated, and the nodes that do it, the last one first."""

    source: ir.Value
    nodes: tuple[ir.Node, ...]

    @property
    def broadcasts(self) -> bool:
        """Whether it is one node that repeats axes of size 1."""
        return len(self.nodes) == 1 and all(map(broadcasts, self.nodes))


@dataclasses.dataclass(frozen=True)
class Move:
    """The inputs and output shape of a node in front of a repetition."""

    inputs: tuple[ir.Value | None, ...]
    shape: tuple[int, ...]
    found: Repetition


def do_before_repeats(node: ir.Node, rewriter: Rewriter, opset: int) -> bool:
    """Move a node in front of the repetition of its rows; False if it does not pay."""
    if not is_row_wise(node, opset):
        return False
    shape = static_shape(node.outputs[0])
    operands = node.inputs[: 2 if node.op_type in BINARY else 1]
    # Try the operands that have as many rows as the result
    for index, value in enumerate(operands):
        given = static_shape(value)
        if value is None or not shape or not given or given[:-1] != shape[:-1]:
            continue
        if given[-1] != shape[-1] and node.op_type not in REDUCTIONS:
            continue
        found = _repetition(value)
        move = None if found is None else _move(node, index, found)
        if move is not None and _pays(node, move):
            _rewrite(node, move, rewriter)
            return True
    return False


def is_row_wise(node: ir.Node, opset: int) -> bool:
    """Return whether a node maps every element, or every row of the last axis."""
    if not is_standard(node) or any(map(is_read, node.outputs[1:])):
        return False
    if any((rank_of(value) or 0) > 1 for value in node.inputs[2:]):
        return False
    if node.op_type in UNARY or node.op_type in BINARY:
        return True
    # Reductions and normalizations must work along the last axis
    rank = rank_of(node.outputs[0]) or 0
    if node.op_type in REDUCTIONS:
        axes = integers_at(node, "axes", 1)
        return bool(node.attributes.get_int("keepdims", 1)) and axes in (
            [-1],
            [rank - 1],
        )
    if node.op_type not in ALONG_AXIS:
        return False
    softmax = node.op_type != "LayerNormalization"
    if not softmax and rank_of(node.inputs[1]) != 1:
        return False
    default = 1 if softmax and opset < SOFTMAX_OPSET else -1
    return node.attributes.get_int("axis", default) in (-1, rank - 1)


def _repetition(value: ir.Value) -> Repetition | None:
    best, least = None, math.prod(static_shape(value) or ())
    nodes: list[ir.Node] = []
    while len(nodes) < LONGEST:
        node = value.producer()
        if node is None or node.graph is not value.graph:
            break
        sources = moved_rows(node)
        if sources is None or len(set(sources)) != 1:  # a Concat may repeat one
            break
        nodes.append(node)
        value = sources[0]
        size = math.prod(static_shape(value) or ())
        if size < least:
            best, least = Repetition(value, tuple(nodes)), size
    return best


def _move(node: ir.Node, index: int, found: Repetition) -> Move | None:
    """Return a node's inputs and shape in front of a repetition; None if impossible."""
    small = static_shape(found.source)
    if not small:
        return None
    inputs = list(node.inputs)
    inputs[index] = found.source
    if node.op_type not in BINARY:
        ends = (static_shape(node.outputs[0]) or ())[-1:]
        return Move(tuple(inputs), (*small[:-1], *ends), found)
    # A single row broadcasts before the repetition as after it
    other = static_shape(node.inputs[1 - index]) if len(inputs) == 2 else None
    if other is None:
        return None
    if math.prod(other[:-1]) == 1 and len(other) <= len(small):
        return Move(tuple(inputs), small, found)
    if not found.broadcasts:
        return None
    # Otherwise both operands must broadcast to less than the result
    again = without_repeats(node.inputs[1 - index])
    if again is not None:
        inputs[1 - index] = again
        other = static_shape(again) or ()
    inner = np.broadcast_shapes(small, other)
    whole = static_shape(node.outputs[0]) or ()
    if math.prod(inner) >= math.prod(whole):
        return None
    return Move(tuple(inputs), inner, found)


def _pays(node: ir.Node, move: Move) -> bool:
    whole = static_shape(node.outputs[0]) or ()
    # Bytes that the node no longer reads and writes
    saved = _traffic(node.inputs) - _traffic(move.inputs)
    item = item_bytes(node.outputs[0])
    saved += (math.prod(whole) - math.prod(move.shape)) * item
    # Cost of a repetition that other readers still need
    owned, added = True, 0.0
    for moving in move.found.nodes:
        owned = owned and sole_reader(moving.outputs[0]) is not None
        if not owned:  # it stays for others, and is there twice
            moved = _rows(moving.inputs[0]) + _rows(moving.outputs[0])
            added += 1.0 + moved * move.shape[-1] * item / MOVED_BYTES_PER_NODE
    return saved / MOVED_BYTES_PER_NODE > added


def _rows(value: ir.Value | None) -> int:
    return math.prod((static_shape(value) or ())[:-1])


def _traffic(values: Sequence[ir.Value | None]) -> float:
    return sum(value_bytes(value) or 0 for value in values if value is not None)


def _rewrite(node: ir.Node, move: Move, rewriter: Rewriter) -> None:
    old, found = node.outputs[0], move.found
    inputs, attributes = along_last(node, move.inputs, len(move.shape), rewriter)
    # Write the node on the source, then repeat its result
    new = rewriter.write(
        node.op_type, inputs, attributes, move.shape, sources=(node,), like=old
    )
    if found.broadcasts:
        shape = static_shape(old) or ()
        target = rewriter.target(shape, f"{old.name}_shape")
        sources = (node, *found.nodes)
        new = rewriter.write(
            "Expand", [new, target], [], shape, sources=sources, like=old
        )
    for moving in () if found.broadcasts else reversed(found.nodes):
        count = len(moving.inputs) if moving.op_type == "Concat" else 1
        kind, inputs, attributes, shape = rewriter.move(moving, [new] * count)
        new = rewriter.write(
            kind, inputs, attributes, shape, sources=(node, moving), like=old
        )
    rewriter.swap(old, new)


def along_last(
    node: ir.Node,
    inputs: Sequence[ir.Value | None],
    rank: int,
    rewriter: Rewriter,
) -> tuple[list[ir.Value | None], list[ir.Attr]]:
    """Return a moved node's inputs and attributes, its axis being the last."""
    given, attributes = list(inputs), dict(node.attributes)
    if node.op_type in ALONG_AXIS:
        attributes["axis"] = ir.AttrInt64("axis", rank - 1)
    elif "axes" in attributes:
        attributes["axes"] = ir.AttrInt64s("axes", [rank - 1])
    elif node.op_type in REDUCTIONS:
        given[1] = rewriter.target((rank - 1,), f"{node.outputs[0].name}_axes")
    return given, list(attributes.values())
