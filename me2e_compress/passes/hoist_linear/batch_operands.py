"""Attention over keys or values that are partly the same for every batch.

Given:   keys = A + p P, A the same for every batch;  MatMul(q, heads of keys)

Result:  MatMul(q, heads of A) + MatMul(MatMul(q, heads of P), p)

Terms shared by the batch need not be repeated, and a term of few columns (positions:
two) is multiplied by the queries before it becomes wide.
"""

import dataclasses

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import macs, static_shape
from me2e_compress.graph.rewrite import Array, maker, sole_reader
from me2e_compress.passes.hoist_linear.head_layout import HeadLayout, layout_of
from me2e_compress.passes.hoist_linear.least_work import terms_of
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer, layer_behind
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.row_moves import without_repeats
from me2e_compress.passes.work import work


@dataclasses.dataclass(frozen=True)
class BatchOperand:
    """The right operand of a batched product: shared terms and narrow layers."""

    layout: HeadLayout
    shared: tuple[ir.Value, ...]
    narrow: tuple[LinearLayer, ...]
    nodes: tuple[ir.Node, ...]


def split_operand(product: ir.Node, rewriter: Rewriter) -> int | None:
    """Multiply by the terms of an operand apart; return saved MACs, None if none."""
    found = _operand(product)
    if found is None or product.inputs[0] is None:
        return None
    # Write the alternative, then compare the work of both
    writer = _Writer(product, found, rewriter)
    new = writer.result()
    before = sum(map(work, (product, *found.nodes)))
    saved = sum(macs(node) or 0 for node in (product, *found.nodes))
    made = [node for value in writer.values if (node := value.producer()) is not None]
    saved -= sum(macs(node) or 0 for node in made)
    if saved < 0 or before - sum(map(work, made)) < 1.0:
        rewriter.undo(writer.values)
        return None
    rewriter.swap(product.outputs[0], new)
    return saved


def _operand(product: ir.Node) -> BatchOperand | None:
    if product.op_type != "MatMul" or product.domain not in ("", "ai.onnx"):
        return None
    # The batch axes of both operands must agree
    right = product.inputs[1]
    layout = None if right is None else layout_of(right)
    left = static_shape(product.inputs[0])
    if right is None or layout is None or left is None:
        return None
    if left[:-2] != (static_shape(right) or ())[:-2]:
        return None
    terms = _terms(layout.value)
    if terms is None:
        return None
    shared, narrow = [], []
    nodes = [*layout.nodes, *terms[1]]
    # Every term must be shared by the batch, or narrow
    for value in terms[0]:
        layer = layer_behind(value)
        if layout.is_shared(static_shape(value)):
            shared.append(value)
        elif layer is not None and layout.is_whole(static_shape(layer.source)):
            if any(sole_reader(node.outputs[0]) is None for node in layer.nodes):
                return None
            narrow.append(layer)
            nodes.extend(layer.nodes)
        else:
            return None
    if not shared and any(layer.bias() is not None for layer in narrow):
        return None
    return BatchOperand(layout, tuple(shared), tuple(narrow), tuple(nodes))


def _terms(value: ir.Value) -> tuple[list[ir.Value], list[ir.Node]] | None:
    if sole_reader(value) is None:
        return None
    # A repetition is a sum of one term
    node, source = value.producer(), without_repeats(value)
    if node is not None and source is not None:
        return [source], [node]
    total = maker(value, "Add")
    if total is None:
        return None
    # Nodes between the sum and its terms go, too
    found = [term for term, _, _ in terms_of(total, static_shape(value) or ())]
    between = [
        repeat
        for operand in total.inputs
        if operand is not None
        and operand not in found
        and (repeat := operand.producer()) is not None
        and sole_reader(operand) is not None
    ]
    return (found, [total, *between]) if found else None


class _Writer:
    def __init__(
        self, product: ir.Node, found: BatchOperand, rewriter: Rewriter
    ) -> None:
        self.product, self.found, self.rewriter = product, found, rewriter
        self.values: list[ir.Value] = []

    def result(self) -> ir.Value:
        layout, out = self.found.layout, self.product.outputs[0]
        left = self.product.inputs[0]
        assert left is not None
        # Give the queries axes of batch and heads, and their scale
        matrix = (static_shape(left) or ())[-2:]
        left = self._shape(left, (layout.batch, layout.heads, *matrix))
        if layout.scale != 1.0:
            factor = self._constant(np.array(layout.scale), "scale")
            left = self._write("Mul", [left, factor], static_shape(left) or ())
        total: ir.Value | None = None
        # Biases are added to one shared term
        biases = [layer.bias() for layer in self.found.narrow]
        for value in self.found.shared:
            for bias in biases:
                if bias is not None:
                    added = self._constant(bias, "bias")
                    shape = static_shape(value) or ()
                    value = self._write("Add", [value, added], shape)
            biases = []
            total = self._plus(total, self._multiply(left, self._heads(value)))
        for layer in self.found.narrow:
            total = self._plus(total, self._narrow(left, layer))
        assert total is not None
        return self._shape(total, static_shape(out) or ())

    def _narrow(self, left: ir.Value, layer: LinearLayer) -> ir.Value:
        """Multiply by a layer's matrix and its source, the smaller first."""
        layout = self.found.layout
        matrix = layer.matrix().reshape(-1, layout.heads, layout.channels)
        source = self._tokens(layer.source)
        if layout.turned:
            turned = self._constant(matrix.transpose(1, 2, 0)[None], "heads")
            return self._multiply(self._multiply(left, turned), source)
        heads = self._constant(matrix.transpose(1, 0, 2)[None], "heads")
        return self._multiply(self._multiply(left, source), heads)

    def _heads(self, value: ir.Value) -> ir.Value:
        """Split a value into heads: [1, H, J, D], or [1, H, D, J] if turned."""
        layout = self.found.layout
        ends = (layout.heads, layout.channels)
        tokens = (layout.tokens, 1) if layout.batch_axis else (1, layout.tokens)
        split = self._shape(value, (*tokens, *ends))
        first, second = (1, 0) if layout.batch_axis else (0, 1)
        order = [first, 2, 3, second] if layout.turned else [first, 2, second, 3]
        return self._transpose(split, order)

    def _tokens(self, value: ir.Value) -> ir.Value:
        """Give rows an axis of heads: [B, 1, J, C], or [B, 1, C, J] if turned."""
        layout = self.found.layout
        first, second = (1, 0) if layout.batch_axis else (0, 1)
        order = [first, 2, second] if layout.turned else [first, second, 2]
        moved = self._transpose(value, order) if order != [0, 1, 2] else value
        return self._shape(moved, (layout.batch, 1, *(static_shape(moved) or ())[1:]))

    def _transpose(self, value: ir.Value, order: list[int]) -> ir.Value:
        old = static_shape(value) or ()
        shape = tuple(old[axis] for axis in order)
        return self._write("Transpose", [value], shape, [ir.AttrInt64s("perm", order)])

    def _shape(self, value: ir.Value, shape: tuple[int, ...]) -> ir.Value:
        if static_shape(value) == shape:
            return value
        target = self.rewriter.target(shape, f"{self.product.name}_shape")
        return self._write("Reshape", [value, target], shape)

    def _multiply(self, left: ir.Value, right: ir.Value) -> ir.Value:
        rows, columns = (
            (static_shape(left) or ())[:-1],
            (static_shape(right) or ())[-1:],
        )
        return self._write("MatMul", [left, right], (*rows, *columns))

    def _plus(self, one: ir.Value | None, two: ir.Value) -> ir.Value:
        if one is None:
            return two
        return self._write("Add", [one, two], static_shape(one) or ())

    def _constant(self, numbers: Array, name: str) -> ir.Value:
        dtype = self.product.outputs[0].dtype
        assert dtype is not None
        array = numbers.astype(dtype.numpy())
        return self.rewriter.store(array, f"{self.product.name}_{name}")

    def _write(
        self,
        op_type: str,
        inputs: list[ir.Value],
        shape: tuple[int, ...],
        attributes: list[ir.Attr] | None = None,
    ) -> ir.Value:
        value = self.rewriter.write(
            op_type,
            inputs,
            attributes or [],
            shape,
            sources=(self.product, *self.found.nodes),
            like=self.product.outputs[0],
        )
        self.values.append(value)
        return value
