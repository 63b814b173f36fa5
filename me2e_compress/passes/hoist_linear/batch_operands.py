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
from me2e_compress.graph.rewrite import maker, sole_reader
from me2e_compress.passes.hoist_linear.head_layout import HeadLayout, layout_of
from me2e_compress.passes.hoist_linear.least_work import terms_of
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer, layer_behind
from me2e_compress.passes.hoist_linear.node_writer import NodeWriter
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter
from me2e_compress.passes.hoist_linear.row_moves import without_repeats
from me2e_compress.passes.work import work

READ = "something else reads them, or the layer behind a term"
OTHER = "a term is neither shared by the batch nor a layer of few columns"
DEAR = "their terms apart are no less work"


@dataclasses.dataclass(frozen=True)
class BatchOperand:
    """The right operand of a batched product: shared terms and narrow layers."""

    layout: HeadLayout
    shared: tuple[ir.Value, ...]
    narrow: tuple[LinearLayer, ...]
    nodes: tuple[ir.Node, ...]


def split_operand(product: ir.Node, rewriter: Rewriter) -> int | str | None:
    """Multiply by the terms of an operand apart; return the saved MACs.

    Of an operand with such terms that stays whole, return why; of others, None.
    """
    found = _operand(product)
    if found is None or isinstance(found, str):
        return found
    # Write the alternative, then compare the work of both
    writer = _Writer(product, found, rewriter)
    new = writer.result()
    before = sum(map(work, (product, *found.nodes)))
    saved = sum(macs(node) or 0 for node in (product, *found.nodes))
    saved -= sum(macs(node) or 0 for node in writer.nodes)
    if saved < 0 or before - sum(map(work, writer.nodes)) < 1.0:
        writer.undo()
        return DEAR
    rewriter.swap(product.outputs[0], new)
    return saved


def _operand(product: ir.Node) -> BatchOperand | str | None:
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
    terms, sums = _terms(layout.value)
    shared, narrow, others = [], [], 0
    nodes = [*layout.nodes, *sums]
    # Every term must be shared by the batch, or narrow
    for value in terms:
        rows, layer = _shared(value, layout), layer_behind(value)
        if rows is not None:
            shared.append(rows)
            nodes.extend(_repetition(value, rows))
        elif layer is not None and layout.is_whole(static_shape(layer.source)):
            narrow.append(layer)
            nodes.extend(layer.nodes)
        else:
            others += 1
    if others:
        return _reason(layout, bool(shared or narrow))
    if any(
        sole_reader(each.outputs[0]) is None for one in narrow for each in one.nodes
    ):
        return READ
    if not shared and any(layer.bias() is not None for layer in narrow):
        return None
    return BatchOperand(layout, tuple(shared), tuple(narrow), tuple(nodes))


def _reason(layout: HeadLayout, fits: bool) -> str | None:
    """Return why an operand stays whole, if it has some terms that fit."""
    if fits:
        return OTHER
    total = maker(layout.value, "Add")
    if total is None or sole_reader(layout.value) is not None:
        return None
    terms = terms_of(total, static_shape(layout.value) or ())
    found = (_shared(value, layout) for value, _, _ in terms)
    return READ if any(each is not None for each in found) else None


def _shared(value: ir.Value, layout: HeadLayout) -> ir.Value | None:
    """Return the rows that a term has for every batch entry, or repeats for each."""
    sources = (value, without_repeats(value))
    return next((v for v in sources if layout.is_shared(static_shape(v))), None)


def _repetition(value: ir.Value, rows: ir.Value) -> tuple[ir.Node, ...]:
    """Return the node that repeats rows, if only the term needs it."""
    node = value.producer()
    owned = value is not rows and sole_reader(value) is not None
    return (node,) if owned and node is not None else ()


def _terms(value: ir.Value) -> tuple[list[ir.Value], list[ir.Node]]:
    """Return the terms of a sum, and the nodes that go with it, the last one first."""
    terms: list[ir.Value] = []
    nodes: list[ir.Node] = []
    waiting = [value]
    while waiting:
        last = waiting.pop()
        total = maker(last, "Add")
        if total is None or sole_reader(last) is None or layer_behind(last) is not None:
            terms.append(last)
            continue
        found = [term for term, _, _ in terms_of(total, static_shape(last) or ())]
        if not found:
            terms.append(last)
            continue
        # Nodes between the sum and its terms go, too
        between = [
            repeat
            for operand in total.inputs
            if operand is not None
            and operand not in found
            and (repeat := operand.producer()) is not None
            and sole_reader(operand) is not None
        ]
        nodes.extend((total, *between))
        waiting.extend(reversed(found))
    return terms, nodes


class _Writer(NodeWriter):
    def __init__(
        self, product: ir.Node, found: BatchOperand, rewriter: Rewriter
    ) -> None:
        super().__init__(rewriter, (product, *found.nodes))
        self.product, self.found = product, found

    def result(self) -> ir.Value:
        layout, out = self.found.layout, self.product.outputs[0]
        left = self.product.inputs[0]
        assert left is not None
        # Give the queries axes of batch and heads, and their scale
        matrix = (static_shape(left) or ())[-2:]
        left = self.shape(left, (layout.batch, layout.heads, *matrix))
        if layout.scale != 1.0:
            factor = self.constant(np.array(layout.scale), "scale")
            left = self.write("Mul", [left, factor], static_shape(left) or ())
        # One product with the sum of what the batch shares, the biases among it
        shared: ir.Value | None = None
        for rows in self.found.shared:
            shared = self.plus(shared, rows)
        for layer in self.found.narrow:
            bias = layer.bias()
            if bias is not None:
                shared = self.plus(shared, self.constant(bias, "bias"))
        # And one with every narrow layer
        total = None if shared is None else self.multiply(left, self._heads(shared))
        for layer in self.found.narrow:
            total = self.plus(total, self._narrow(left, layer))
        assert total is not None
        return self.shape(total, static_shape(out) or ())

    def _narrow(self, left: ir.Value, layer: LinearLayer) -> ir.Value:
        """Multiply by a layer's matrix and its source, the smaller first."""
        layout = self.found.layout
        matrix = layer.matrix().reshape(-1, layout.heads, layout.channels)
        source = self._tokens(layer.source)
        if layout.turned:
            turned = self.constant(matrix.transpose(1, 2, 0)[None], "heads")
            return self.multiply(self.multiply(left, turned), source)
        heads = self.constant(matrix.transpose(1, 0, 2)[None], "heads")
        return self.multiply(self.multiply(left, source), heads)

    def _heads(self, value: ir.Value) -> ir.Value:
        """Split a value into heads: [1, H, J, D], or [1, H, D, J] if turned."""
        layout = self.found.layout
        ends = (layout.heads, layout.channels)
        tokens = (layout.tokens, 1) if layout.batch_axis else (1, layout.tokens)
        split = self.shape(value, (*tokens, *ends))
        first, second = (1, 0) if layout.batch_axis else (0, 1)
        order = [first, 2, 3, second] if layout.turned else [first, 2, second, 3]
        return self.transpose(split, order)

    def _tokens(self, value: ir.Value) -> ir.Value:
        """Give rows an axis of heads: [B, 1, J, C], or [B, 1, C, J] if turned."""
        layout = self.found.layout
        first, second = (1, 0) if layout.batch_axis else (0, 1)
        order = [first, 2, second] if layout.turned else [first, second, 2]
        moved = self.transpose(value, order)
        return self.shape(moved, (layout.batch, 1, *(static_shape(moved) or ())[1:]))
