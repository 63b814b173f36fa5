"""Linear layers: a product with a constant matrix, and an added vector."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, static_shape
from me2e_compress.graph.rewrite import (
    FLOATS,
    Numbers,
    holds_numbers,
    maker,
    numbers_of,
    sole_reader,
)


@dataclasses.dataclass(frozen=True)
class LinearLayer:
    """``source @ weight + bias``: a MatMul or Gemm, and the Add of a separate bias."""

    product: ir.Node
    sum: ir.Node | None

    @property
    def source(self) -> ir.Value:
        """The rows, [..., K]."""
        value = self.product.inputs[0]
        assert value is not None
        return value

    @property
    def weight(self) -> ir.Value:
        """The constant matrix, [K, N], or [N, K] where the Gemm transposes it."""
        value = self.product.inputs[1]
        assert value is not None
        return value

    @property
    def result(self) -> ir.Value:
        """The output, [..., N]."""
        return (self.sum or self.product).outputs[0]

    @property
    def nodes(self) -> tuple[ir.Node, ...]:
        """Its nodes, the product first."""
        return (self.product,) if self.sum is None else (self.product, self.sum)

    @property
    def is_plain(self) -> bool:
        """Whether the stored weight is exactly the matrix."""
        return self.product.op_type == "MatMul" or (
            not self.product.attributes.get_int("transB", 0)
            and self.product.attributes.get_float("alpha", 1.0) == 1.0
        )

    def matrix(self) -> Numbers:
        """Return the matrix, [K, N]."""
        numbers = _known(self.weight)
        if self.product.op_type == "MatMul":
            return numbers
        if self.product.attributes.get_int("transB", 0):
            numbers = numbers.T
        return numbers * self.product.attributes.get_float("alpha", 1.0)

    def bias(self) -> Numbers | None:
        """Return the added vector, [N]; None if there is none."""
        total: Numbers | None = None
        columns = (static_shape(self.result) or ())[-1:]
        # A Gemm has its own bias
        if len(self.product.inputs) > 2 and self.product.inputs[2] is not None:
            beta = self.product.attributes.get_float("beta", 1.0)
            total = _vector(self.product.inputs[2], columns) * beta
        if self.sum is not None:
            added = next(value for value in self.sum.inputs if holds_numbers(value))
            more = _vector(added, columns)
            total = more if total is None else total + more
        return total


def layer_at(product: ir.Node) -> LinearLayer | None:
    """Return the layer of a product, with its bias where nothing else reads it."""
    if not is_product(product):
        return None
    reader = sole_reader(product.outputs[0])
    if reader is not None and reader.op_type == "Add" and _adds_bias(reader, product):
        return LinearLayer(product, reader)
    return LinearLayer(product, None)


def layer_behind(value: ir.Value) -> LinearLayer | None:
    """Return the layer that computes a value."""
    node = maker(value, "MatMul", "Gemm", "Add")
    if node is None or node.op_type != "Add":
        return (
            LinearLayer(node, None) if node is not None and is_product(node) else None
        )
    for operand in node.inputs:
        product = maker(operand, "MatMul", "Gemm")
        if product is not None and is_product(product) and _adds_bias(node, product):
            return LinearLayer(product, node)
    return None


def is_product(node: ir.Node) -> bool:
    """Return whether a node multiplies rows by a constant matrix."""
    if node.op_type not in ("MatMul", "Gemm") or node.domain not in ("", "ai.onnx"):
        return False
    if node.attributes.get_int("transA", 0):
        return False
    rows, result = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if not rows or not result or 0 in rows or node.outputs[0].dtype not in FLOATS:
        return False
    weight = node.inputs[1]
    if len(static_shape(weight) or ()) != 2 or not holds_numbers(weight):
        return False
    if array_of(node.inputs[0]) is not None:
        return False
    bias = node.inputs[2] if len(node.inputs) > 2 else None
    return bias is None or _is_vector(bias, result)


def _adds_bias(node: ir.Node, product: ir.Node) -> bool:
    value, shape = product.outputs[0], static_shape(product.outputs[0])
    others = [operand for operand in node.inputs if operand is not value]
    if shape is None or len(others) != 1 or static_shape(node.outputs[0]) != shape:
        return False
    return _is_vector(others[0], shape)


def _is_vector(value: ir.Value | None, result: tuple[int, ...]) -> bool:
    shape = static_shape(value)
    if shape is None or not holds_numbers(value) or len(shape) > len(result):
        return False
    return math.prod(shape[:-1]) == 1 and (not shape or shape[-1] in (1, result[-1]))


def _vector(value: ir.Value | None, columns: tuple[int, ...]) -> Numbers:
    numbers = _known(value).reshape(-1)
    return np.array(np.broadcast_to(numbers, columns))


def _known(value: ir.Value | None) -> Numbers:
    numbers = numbers_of(value)
    assert numbers is not None
    return numbers
