"""A matrix product of any rank and its bias, as a Gemm of two dimensions."""

from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import rewrite
from me2e_compress.errors import PreconditionError
from me2e_compress.targets.onnxruntime.kernels import biased_end
from me2e_compress.targets.onnxruntime.writer import Writer


def write_gemm(writer: Writer, product: ir.Node, size: Sequence[int]) -> ir.Node:
    """Put a Gemm in the place of a MatMul and the Add behind it.

    Given:   y = Add(MatMul(x, w), b)                           x [..., K], w [K, N]
    Result:  y = Reshape(Gemm(Reshape(x, [-1, K]), w, b), [..., N])

    Args:
        writer: of the graph.
        product: the MatMul, of which only the Add reads.
        size: (K, N).

    Returns:
        The Gemm; its weight and bias are still to be written.

    Raises:
        PreconditionError: there is no such Add.
    """
    addition = biased_end(product)
    left, right = product.inputs
    if addition is None or left is None or left.shape is None or right is None:
        raise PreconditionError(f"{product.name} is no MatMul with a bias")
    old = addition.outputs[0]
    name = str(old.name)
    place = _Place(writer, addition, [product, addition])
    leading = list(left.shape)[:-1]
    rows = left
    if len(leading) > 1:
        rows = place.reshaped(left, [-1, size[0]], f"{name}_rows")
    gemm = place.node("Gemm", [rows, right, right], f"{name}_gemm")
    answer = gemm.outputs[0]
    if len(leading) > 1:
        answer = place.restored(answer, left, leading, size[1], name)
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm


class _Place:
    """Where new nodes stand, and whose heirs they are."""

    def __init__(
        self, writer: Writer, before: ir.Node, sources: Sequence[ir.Node]
    ) -> None:
        self._writer = writer
        self._before = before
        self._sources = sources

    def node(self, op: str, inputs: Sequence[ir.Value], name: str) -> ir.Node:
        node = self._writer.node(op, inputs, name, self._sources)
        node.outputs[0].dtype = ir.DataType.FLOAT
        self._writer.graph.insert_before(self._before, node)
        return node

    def reshaped(self, value: ir.Value, shape: Sequence[int], name: str) -> ir.Value:
        target = self._writer.constant(np.array(shape, np.int64), f"{name}_shape")
        return self.node("Reshape", [value, target], name).outputs[0]

    def restored(
        self,
        rows: ir.Value,
        like: ir.Value,
        leading: Sequence[int | ir.SymbolicDim],
        columns: int,
        name: str,
    ) -> ir.Value:
        """Give [rows, columns] the leading dimensions of another value."""
        known = [dim if isinstance(dim, int) else -1 for dim in leading]
        if known.count(-1) <= 1:
            return self.reshaped(rows, [*known, columns], f"{name}_ranked")
        ends = [
            self._writer.constant(np.array([end], np.int64), f"{name}_end")
            for end in (0, -1, columns)
        ]
        whole = self.node("Shape", [like], f"{name}_dims").outputs[0]
        front = self.node("Slice", [whole, *ends[:2]], f"{name}_leading").outputs[0]
        target = self.node("Concat", [front, ends[2]], f"{name}_target")
        target.attributes.add(ir.AttrInt64("axis", 0))
        for value in (whole, front, target.outputs[0]):
            value.dtype = ir.DataType.INT64
        inputs = [rows, target.outputs[0]]
        return self.node("Reshape", inputs, f"{name}_ranked").outputs[0]
