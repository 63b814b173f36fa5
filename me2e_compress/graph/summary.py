"""Measure a graph: its inputs and outputs, nodes, bytes and MACs."""

import dataclasses
import math
from collections.abc import Callable, Iterable
from typing import TypeVar

import onnx_ir as ir

from me2e_compress.graph.nodes import input_at, is_plugin, nodes_in, nodes_inside
from me2e_compress.graph.shapes import knowledge, static_shape

Counter = Callable[[ir.Node], int | None]
Count = TypeVar("Count")

# Operators of ONNX that multiply matrices, and that no rule here counts
_UNCOUNTED = frozenset(
    {
        "AffineGrid", "CausalConvWithState", "DFT", "Det",
        "LinearAttention", "STFT", "SequenceMap",
    }
)  # fmt: skip

_LOOPS = ("Loop", "Scan")


def macs(node: ir.Node) -> int | None:
    """Return a node's MACs: 0 for operators that multiply no matrices.

    None where they are unknown: of an unknown plugin, a local function, an operator
    without a rule, a loop around one that multiplies, or an open shape.
    """
    if is_plugin(node):
        return knowledge().macs(node)
    if node.op_type in _LOOPS:  # nobody knows how often it runs
        inside = (inner for inner in nodes_inside(node) if inner.op_type not in _LOOPS)
        return 0 if all(macs(inner) == 0 for inner in inside) else None
    if node.op_type in _UNCOUNTED:
        return None
    rule = _RULES.get(node.op_type)
    return 0 if rule is None else rule(node)


def macs_counter(model: ir.Model) -> Counter:
    """Return :func:`macs` for nodes of a model, its functions counted at every call."""

    # A call counts as all nodes of its body; shapes inside are seldom known, so that a
    # function that multiplies matrices is mostly None
    def total(counts: Iterable[int | None]) -> int | None:
        known, unknown = total_macs(counts)
        return known if not unknown else None

    return _with_calls(model, macs, total)


def _with_calls(
    model: ir.Model,
    count: Callable[[ir.Node], Count],
    total: Callable[[Iterable[Count]], Count],
) -> Callable[[ir.Node], Count]:
    """Return a counter of nodes; calls of functions are the total of their bodies."""
    bodies: dict[ir.OperatorIdentifier, Count] = {}

    def count_call(node: ir.Node) -> Count:
        key = node.op_identifier()
        function = model.functions.get(key)
        if function is None:
            return count(node)
        if key not in bodies:
            bodies[key] = total(count_call(inner) for inner in nodes_in(function))
        return bodies[key]

    return count_call


def total_macs(counts: Iterable[int | None]) -> tuple[int | None, int]:
    """Add up the MACs of nodes.

    Returns:
        The sum of the known counts, and the number of unknown ones, with which the sum
        is a lower bound. A sum of 0 is None if some are unknown.
    """
    listed = list(counts)
    known = [count for count in listed if count is not None]
    total, unknown = sum(known), len(listed) - len(known)
    return (total if total or not unknown else None), unknown


def _conv(weight: int, *, transposed: bool = False) -> Counter:
    """Count the elements of the output, or of the input, times those of a filter."""

    def count(node: ir.Node) -> int | None:
        kernel = static_shape(input_at(node, weight))
        out = static_shape(node.inputs[0] if transposed else node.outputs[0])
        return None if kernel is None or out is None else math.prod(out + kernel[1:])

    return count


def _product(node: ir.Node) -> int | None:
    """Count a MatMul or Gemm: the elements of the output times the inner dimension."""
    left, out = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if left is None or out is None:
        return None
    # [..., M, K] x [..., K, N]: K times the elements of [..., M, N]
    gemm = node.op_type == "Gemm"
    flipped = gemm and bool(node.attributes.get_int("transA", 0))
    return math.prod(out) * (left[0 if flipped else -1] if left else 1)


def _einsum(node: ir.Node) -> int | None:
    """Count the products of two operands; a sum or transpose of one has none."""
    if len(node.inputs) == 1:
        return 0
    equation = node.attributes.get_string("equation", "").replace(" ", "")
    terms = equation.partition("->")[0].split(",")
    if len(terms) != 2 or len(node.inputs) != 2:
        return None
    sizes: dict[str, int] = {}
    for term, value in zip(terms, node.inputs, strict=True):
        shape = static_shape(value)
        if shape is None:
            return None
        # Name every dimension, those of an ellipsis by number from its end
        before, dots, after = term.partition("...")
        more = len(shape) - len(before) - len(after)
        if more < 0 or (more and not dots):
            return None
        letters = [*before, *(str(more - at) for at in range(more)), *after]
        for letter, size in zip(letters, shape, strict=True):
            sizes[letter] = max(size, sizes.get(letter, 1))
    return math.prod(sizes.values())


def _recurrent(node: ir.Node) -> int | None:
    source, *weights = (static_shape(input_at(node, at)) for at in range(3))
    if source is None or len(source) != 3 or None in weights:
        return None
    elements = sum(math.prod(shape or ()) for shape in weights)
    return source[0] * source[1] * elements  # steps and batch, in either order


def _attention(node: ir.Node) -> int | None:
    """Count both products; the heads are an axis, or within the last one."""
    read = [input_at(node, at) for at in (0, 1, 2, 4)]
    known = [shape for value in read if (shape := static_shape(value))]
    if len(known) != sum(value is not None for value in read):
        return None
    # [batch, heads, tokens, width], or heads within the last axis
    query, key, value, *past = known
    if len(query) == 4:
        width, out = query[1] * query[3], query[1] * value[3]
    else:
        groups = node.attributes.get_int("kv_num_heads", 1)
        width, out = query[2], node.attributes.get_int("q_num_heads", 1) * value[2]
        out //= groups
    keys = key[-2] + sum(shape[2] for shape in past)
    return query[0] * query[-2] * keys * (width + out)


# Conv, DeformConv and ConvTranspose: output (input) elements x kernel volume x channels
# per group. Gemm and MatMul: rows x columns x inner dimension x batch. Einsum of two
# operands: the product of all its dimensions. LSTM, GRU and RNN: steps x batch x
# elements of both weights, which hold all gates and directions. Attention: queries x
# keys x (channels of query + channels of value). Integer forms likewise.
_RULES: dict[str, Counter] = {
    **dict.fromkeys(("Conv", "ConvInteger", "DeformConv"), _conv(1)),
    **dict.fromkeys(("GRU", "LSTM", "RNN"), _recurrent),
    **dict.fromkeys(("Gemm", "MatMul", "MatMulInteger", "QLinearMatMul"), _product),
    "Attention": _attention,
    "ConvTranspose": _conv(1, transposed=True),
    "Einsum": _einsum,
    "QLinearConv": _conv(3),
}


@dataclasses.dataclass(frozen=True)
class Port:
    """One input or output: name, ONNX type and shape as text, e.g. ``[1, 6, 'W']``."""

    name: str
    type: str
    shape: str


def interface(model: ir.Model) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """List the inputs and the outputs: no pass may change these unasked."""
    inputs, outputs = (
        tuple(Port(v.name or "", str(v.type), str(v.shape)) for v in values)
        for values in (model.graph.inputs, model.graph.outputs)
    )
    return inputs, outputs


@dataclasses.dataclass(frozen=True)
class Size:
    """Nodes, weights and cost of a graph.

    Attributes:
        nodes: in subgraphs, too; and in every call of a function.
        graph_nodes: the same without the bodies of functions: a call is one node.
        weight_bytes: bytes of all initializers.
        macs: multiply-accumulates, those known: where others are
            unknown, a lower bound, and None instead of 0.
        unknown_macs_nodes: nodes that are not in ``macs``: plugins, and operators
            of unknown shape.
    """

    nodes: int
    graph_nodes: int
    weight_bytes: int
    macs: int | None
    unknown_macs_nodes: int

    @property
    def counted_nodes(self) -> str:
        """The nodes of the graph, and with the bodies of functions where it has any."""
        if self.graph_nodes == self.nodes:
            return f"{self.nodes}"
        return f"{self.graph_nodes} ({self.nodes} with bodies)"


def size(model: ir.Model) -> Size:
    """Measure a graph."""
    macs, unknown = total_macs(map(macs_counter(model), nodes_in(model.graph)))
    return Size(
        nodes=node_count(model),
        graph_nodes=sum(1 for _ in nodes_in(model.graph)),
        weight_bytes=weight_bytes(model),
        macs=macs,
        unknown_macs_nodes=unknown,
    )


def node_count(model: ir.Model) -> int:
    """Count nodes as a runtime sees them: a function counts at every call."""
    count: Callable[[ir.Node], int] = _with_calls(model, lambda node: 1, sum)
    return sum(map(count, nodes_in(model.graph)))


def weight_bytes(model: ir.Model) -> int:
    """Return the bytes of all initializers."""
    return sum(
        value.const_value.nbytes
        for graph in model.graphs()
        for value in graph.initializers.values()
        if value.const_value is not None
    )


def value_bytes(value: ir.Value) -> int | None:
    """Return the bytes of a value; None if its shape or type is open, or it is text."""
    if value.const_value is not None:
        return int(value.const_value.nbytes)
    shape = static_shape(value)
    if shape is None or value.dtype in (None, ir.DataType.STRING):
        return None
    return math.ceil(math.prod(shape) * value.dtype.itemsize)  # int4: two to a byte


def total_bytes(values: Iterable[ir.Value]) -> int | None:
    """Return the bytes of values; None where a shape or type is open."""
    sizes = [value_bytes(value) for value in values]
    known = [size for size in sizes if size is not None]
    return sum(known) if len(known) == len(sizes) else None
