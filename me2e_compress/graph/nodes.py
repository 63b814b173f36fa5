"""Facts about nodes and values, and about layers with weights."""

import dataclasses
import math
from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph.shapes import open_shape, rank_of, static_shape

STANDARD = ("", "ai.onnx")
"""The two spellings of the domain of ONNX's own operators."""


def is_standard(node: ir.Node) -> bool:
    """Return whether a node is one of ONNX's own operators."""
    return node.domain in STANDARD


def opset_of(imports: ir.Model | ir.Function) -> int:
    """Return the opset of ONNX's own operators that is imported; 0 if none is."""
    found = imports.opset_imports
    return next((found[domain] for domain in STANDARD if domain in found), 0)


def nodes_of(model: ir.Model) -> Iterator[ir.Node]:
    """Walk the nodes of the graph, of its bodies and of its functions."""
    yield from model.graph.all_nodes()
    for function in model.functions.values():
        yield from function.all_nodes()


def input_at(node: ir.Node, index: int) -> ir.Value | None:
    """Return an input of a node; None if it is left out."""
    return node.inputs[index] if index < len(node.inputs) else None


def producer_of(value: ir.Value | None) -> ir.Node | None:
    """Return the node that computes a value; None for inputs and initializers."""
    return None if value is None else value.producer()


def has_subgraph(node: ir.Node) -> bool:
    """Return whether a node carries a graph of its own (If, Loop, Scan, ...)."""
    kinds = (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)
    return any(attribute.type in kinds for attribute in node.attributes.values())


def graphs_of(graph: ir.Graph) -> Iterator[ir.Graph]:
    """Walk a graph and all the graphs inside its nodes, outermost first."""
    yield graph
    for node in graph:
        for attribute in node.attributes.values():
            if attribute.type == ir.AttributeType.GRAPH:
                yield from graphs_of(attribute.as_graph())
            elif attribute.type == ir.AttributeType.GRAPHS:
                for inner in attribute.as_graphs():
                    yield from graphs_of(inner)


def array_of(value: ir.Value | None) -> npt.NDArray[np.generic] | None:
    """Return the array of an initializer or Constant; None if the value is computed."""
    if value is None or value.is_graph_input():
        return None
    if value.const_value is not None and value.is_initializer():
        return value.const_value.numpy()
    if value.producer() is None:
        return None
    tensor = ir.convenience.get_const_tensor(value)
    return None if tensor is None else tensor.numpy()


CONVOLUTIONS = ("Conv", "ConvTranspose")
WEIGHTED = (*CONVOLUTIONS, "Gemm", "MatMul")
"""Operators of weighted layers: those that have an int8 kernel worth feeding."""

Dims = tuple[int | None, ...]


def bias_of(node: ir.Node) -> ir.Value | None:
    """Return the bias of a Conv, ConvTranspose or Gemm; None if it has none."""
    return input_at(node, 2)


def channel_axis(node: ir.Node) -> int:
    """Return the axis of a layer's weight along which its output channels run.

    Conv [M, C/g, ...]: 0. ConvTranspose [C, M/g, ...]: 1. MatMul [..., K, N]: the last.
    Gemm [K, N]: 1, or 0 where it is transposed.
    """
    if node.op_type == "Conv":
        return 0
    if node.op_type == "ConvTranspose":
        return 1
    if node.op_type == "Gemm":
        return 0 if node.attributes.get_int("transB", 0) else 1
    weight = node.inputs[1]
    rank = 2 if weight is None or weight.shape is None else len(weight.shape)
    return rank - 1


@dataclasses.dataclass(frozen=True)
class Extent:
    """Size of one matrix product, [M, K] x [K, N].

    Attributes:
        rows: M: of a product with a plain weight, all leading dimensions together;
            of a batch of products, the rows of one. None where that is open.
        columns: N, likewise of one product.
        depth: K, what is summed over.
    """

    rows: int | None
    columns: int | None
    depth: int | None

    @property
    def is_vector(self) -> bool:
        """Whether it degenerates to a matrix-vector product."""
        return 1 in (self.rows, self.columns)


def extent(node: ir.Node, *, weight: bool) -> Extent:
    """Measure a MatMul or Gemm.

    A weight of shape [K, N] (or [1, ..., K, N]) is shared by every row, whatever the
    rank of the left operand: [1, 1, 256] x [256, 12] has one row, and so does
    [1, 256] x [256, 12]. Where the right operand differs from batch to batch, the rows
    of one batch count.

    Args:
        node: the product.
        weight: whether its right operand is constant.
    """
    left, right = open_shape(node.inputs[0]), open_shape(node.inputs[1])
    if node.op_type == "Gemm":
        return _gemm(node, left, right)
    columns, depth = (None, None) if right is None else _sides(right)
    if not left:
        return Extent(None, columns, depth)
    shared = weight and right is not None and _product(right[:-2]) == 1
    rows = _product(left[:-1]) if shared or len(left) == 1 else left[-2]
    return Extent(rows, columns, depth if left[-1] is None else left[-1])


def is_one_matrix(product: ir.Node) -> bool:
    """Return whether a MatMul multiplies every row by one and the same matrix.

    Its right operand is [K, N] then, or [1, ..., K, N] of no more dimensions than the
    left one has: without the leading ones it gives the same.
    """
    left, right = product.inputs[0], static_shape(product.inputs[1])
    if right is None or len(right) < 2:
        return False
    rank = rank_of(left) or 0
    return len(right) == 2 or (math.prod(right[:-2]) == 1 and len(right) <= rank)


def _product(dims: Dims) -> int | None:
    """Multiply dimensions; None if one of them is open."""
    known = [dim for dim in dims if dim is not None]
    return math.prod(known) if len(known) == len(dims) else None


def _sides(right: Dims) -> tuple[int | None, int | None]:
    """Return N and K of a right operand; a vector is one column."""
    return (right[-1], right[-2]) if len(right) > 1 else (1, _product(right))


def _gemm(node: ir.Node, left: Dims | None, right: Dims | None) -> Extent:
    flip_left = bool(node.attributes.get_int("transA", 0))
    flip_right = bool(node.attributes.get_int("transB", 0))
    return Extent(
        None if left is None else left[1 if flip_left else 0],
        None if right is None else right[0 if flip_right else 1],
        None if right is None else right[1 if flip_right else 0],
    )
