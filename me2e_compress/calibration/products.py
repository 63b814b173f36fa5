"""The shape of a matrix product: rows, columns, and which operand is a weight."""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.graph import static_shape


def is_constant(value: ir.Value | None) -> bool:
    """Say whether a value is an initializer or what a Constant node gives."""
    if value is None or value.is_graph_input():
        return False
    producer = value.producer()
    if producer is None:
        return value.is_initializer()
    return producer.op_type == "Constant" and producer.domain in ("", "ai.onnx")


def is_product(node: ir.Node) -> bool:
    """Say whether a node multiplies by a matrix that is computed, not a weight.

    The left one may be constant: learned queries that have not met the scene yet.
    """
    return (
        node.domain in ("", "ai.onnx")
        and node.op_type in ("MatMul", "Gemm", "Einsum")
        and len(node.inputs) >= 2
        and node.inputs[1] is not None
        and not is_constant(node.inputs[1])
    )


@dataclasses.dataclass(frozen=True)
class Extent:
    """Size of one matrix product as a kernel sees it.

    Attributes:
        rows: M: of a product with a plain weight, all leading dimensions together;
            of a batch of products, the rows of one. None where the shape is open.
        columns: N, likewise of one product.
    """

    rows: int | None
    columns: int | None

    @property
    def is_vector(self) -> bool:
        """Whether it degenerates to a matrix-vector product."""
        return 1 in (self.rows, self.columns)


def extent(node: ir.Node) -> Extent:
    """Measure a MatMul or Gemm.

    A constant right operand of shape [K, N] (or [1, ..., K, N]) is shared by every
    row, whatever the rank of the left one: [1, 1, 256] x [256, 12] has one row, and so
    does [1, 256] x [256, 12]. Where the right operand differs from batch to batch, the
    rows of one batch count.
    """
    left, right = static_shape(node.inputs[0]), static_shape(node.inputs[1])
    if node.op_type == "Gemm":
        flip_left = bool(node.attributes.get_int("transA", 0))
        flip_right = bool(node.attributes.get_int("transB", 0))
        return Extent(
            None if left is None else left[1 if flip_left else 0],
            None if right is None else right[0 if flip_right else 1],
        )
    shared = (
        right is not None and is_constant(node.inputs[1]) and math.prod(right[:-2]) == 1
    )
    columns = None if right is None else (right[-1] if len(right) > 1 else 1)
    if left is None:
        return Extent(None, columns)
    if shared or len(left) < 2:
        return Extent(math.prod(left[:-1]), columns)
    return Extent(left[-2], columns)
