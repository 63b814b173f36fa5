"""What is done to every row alike is done once where rows repeat each other.

Given:   Expand(x) -> Add(bias) -> LayerNormalization -> Relu
Result:  x -> Add(bias) -> LayerNormalization -> Relu -> Expand
"""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import is_standard, rank_of, static_shape
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.row_moves import broadcasts, moved_rows
from me2e_compress.passes.work import MOVED_BYTES_PER_NODE, work
from me2e_compress.rewrite import is_read, sole_reader

UNARY = frozenset(
    {
        *("Abs", "Celu", "Clip", "Cos", "Elu", "Erf", "Exp", "Gelu", "HardSigmoid"),
        *("HardSwish", "Identity", "LeakyRelu", "Log", "Mish", "Neg", "Reciprocal"),
        *("Relu", "Selu", "Sigmoid", "Sin", "Softplus", "Softsign", "Sqrt", "Tanh"),
    }
)
"""Operators that map every element by itself."""

BINARY = frozenset({"Add", "Div", "Max", "Min", "Mul", "Pow", "Sub"})
"""Operators that map pairs of elements, and repeat what is smaller."""

ALONG_AXIS = frozenset({"LayerNormalization", "LogSoftmax", "Softmax"})
"""Operators that map every row by itself where their axis is the last."""

SOFTMAX_OPSET = 13
"""Before, the axis of a softmax was the second by default."""

LONGEST = 16
"""How many nodes in a row may lie between what is repeated and what reads it."""


@dataclasses.dataclass(frozen=True)
class Repetition:
    """Where rows are repeated.

    Attributes:
        source: the value before it.
        nodes: those that rearrange and repeat its rows, the last one first.
    """

    source: ir.Value
    nodes: tuple[ir.Node, ...]

    @property
    def broadcasts(self) -> bool:
        """Whether it is one node that repeats axes of size 1."""
        return len(self.nodes) == 1 and all(map(broadcasts, self.nodes))


def do_before_repeats(node: ir.Node, rewriter: Rewriter, opset: int) -> bool:
    """Move a node in front of the repetition of its rows; False if it does not pay."""
    if not _is_row_wise(node, opset):
        return False
    shape = static_shape(node.outputs[0])
    for index, value in enumerate(node.inputs[:2]):
        if value is None or shape is None or static_shape(value) != shape:
            continue
        found = _repetition(value)
        inner = None if found is None else _inner_shape(node, index, found)
        if found is None or inner is None or not _pays(node, found, inner):
            continue
        _rewrite(node, index, found, inner, rewriter)
        return True
    return False


def _is_row_wise(node: ir.Node, opset: int) -> bool:
    if not is_standard(node) or any(map(is_read, node.outputs[1:])):
        return False
    if any((rank_of(value) or 0) > 1 for value in node.inputs[2:]):
        return False
    if node.op_type in UNARY or node.op_type in BINARY:
        return True
    if node.op_type not in ALONG_AXIS:
        return False
    softmax = node.op_type != "LayerNormalization"
    if not softmax and rank_of(node.inputs[1]) != 1:
        return False
    default = 1 if softmax and opset < SOFTMAX_OPSET else -1
    rank = len(static_shape(node.outputs[0]) or ())
    axis = node.attributes.get_int("axis", default)
    return axis in (-1, rank - 1)


def _repetition(value: ir.Value) -> Repetition | None:
    """Find the value with the fewest rows that one is rearranged and repeated from."""
    best, least = None, math.prod(static_shape(value) or ())
    nodes: list[ir.Node] = []
    while len(nodes) < LONGEST:
        node = value.producer()
        if node is None or node.graph is not value.graph:
            break
        sources = moved_rows(node)
        if sources is None or len(sources) != 1:
            break
        nodes.append(node)
        value = sources[0]
        size = math.prod(static_shape(value) or ())
        if size < least:
            best, least = Repetition(value, tuple(nodes)), size
    return best


def _inner_shape(
    node: ir.Node, index: int, found: Repetition
) -> tuple[int, ...] | None:
    """Return the shape of what a node gives in front of a repetition; None if never.

    The other operand is one row, or what is repeated is repeated along axes that the
    other operand does not have.
    """
    small = static_shape(found.source)
    if small is None or node.op_type not in BINARY:
        return small
    if len(node.inputs) != 2:
        return None
    other = static_shape(node.inputs[1 - index])
    whole = static_shape(node.outputs[0]) or ()
    if other is None:
        return None
    if math.prod(other[:-1]) == 1 and len(other) <= len(small):
        return small
    if not found.broadcasts:
        return None
    inner = np.broadcast_shapes(small, other)
    return inner if math.prod(inner) < math.prod(whole) else None


def _pays(node: ir.Node, found: Repetition, inner: tuple[int, ...]) -> bool:
    """Return whether a node's smaller work is worth the repetition of what it gives."""
    dtype = node.outputs[0].dtype
    item = 4.0 if dtype is None else dtype.itemsize
    whole = math.prod(static_shape(node.outputs[0]) or ())
    saved = 2 * (whole - math.prod(inner)) * item / MOVED_BYTES_PER_NODE
    owned, added = True, 0.0
    for moving in found.nodes:
        owned = owned and sole_reader(moving.outputs[0]) is not None
        added += 0.0 if owned else work(moving)
    return saved >= added + 1.0


def _rewrite(
    node: ir.Node,
    index: int,
    found: Repetition,
    inner: tuple[int, ...],
    rewriter: Rewriter,
) -> None:
    inputs = [found.source if at == index else v for at, v in enumerate(node.inputs)]
    old = node.outputs[0]
    attributes = list(node.attributes.values())
    new = rewriter.write(
        node.op_type, inputs, attributes, inner, sources=(node,), like=old
    )
    for moving in reversed(found.nodes):
        kind, given, attributes, shape = rewriter.move(moving, [new])
        sources = (node, moving)
        if found.broadcasts:
            shape = static_shape(old) or ()
            kind, attributes = "Expand", []
            given = [new, rewriter.target(shape, f"{old.name}_shape")]
        new = rewriter.write(kind, given, attributes, shape, sources=sources, like=old)
    rewriter.swap(old, new)
