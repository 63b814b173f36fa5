"""Multiply many rows by a matrix in one product instead of one product per row."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.base.display import plural
from me2e_compress.graph import is_standard, opset_of, static_shape
from me2e_compress.graph.nodes import graphs_of
from me2e_compress.graph.rewrite import remove_dead, remove_unread, value_names
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.graph.summary import value_bytes
from me2e_compress.operators import FusedCall
from me2e_compress.passes.base import Context, Pass, PassResult
from me2e_compress.passes.hoist_linear.repeats import repeated_axes
from me2e_compress.passes.hoist_linear.sums import replace
from me2e_compress.passes.work import (
    MOVED_BYTES_PER_NODE,
    SMALL_PRODUCTS_PER_NODE,
    small_products,
)

Shape = tuple[int, ...]


@dataclasses.dataclass(frozen=True)
class FlattenMatmul(Pass):
    """Multiply all points by a camera's matrix at once, not the matrix by each point.

    Given:   MatMul(matrices [6, 1, 4, 4], points [1, 40000, 4, 1])

    Result:  MatMul(points [1, 40000, 4], transposed matrices [6, 4, 4])

    The batch axes along which one operand is broadcast become rows of the other: the
    last ones by a view, others behind a transposition, which is undone. Of vectors, the
    transposed product is taken. Repetitions in front of a product that
    broadcasts by itself (Tile, Expand) are not read any more. A product is rewritten
    where that saves more starts of small products than the views around it cost
    (:mod:`me2e_compress.passes.work`). Sizes must be known. Products and their sums are
    the same; a runtime may add them up in another order.
    """

    name = "flatten-matmul"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Rewrite every product that has a cheaper form, until none has."""
        opset = opset_of(model)
        if opset < OLDEST_OPSET:
            return PassResult(model, 0)
        # A rewritten product may have a cheaper form again
        repeats = flattened = 0
        names = value_names(model.graph)
        for body in graphs_of(model.graph):
            for node in list(body):
                if node.op_type != "MatMul" or not is_standard(node):
                    continue
                product: ir.Node | None = node
                while product is not None:
                    call = FusedCall(product, opset=opset, by=self.name, names=names)
                    repeats += _read_unrepeated(call)
                    product = _flatten(call)
                    flattened += product is not None
        if repeats or flattened:
            remove_dead(model.graph)
        notes = (
            (flattened, f"flattened {plural(flattened, 'product')}"),
            (repeats, f"{plural(repeats, 'repeated operand')} read unrepeated"),
        )
        remarks = tuple(note for count, note in notes if count)
        return PassResult(model, repeats + flattened, remarks)


@dataclasses.dataclass(frozen=True)
class _Form:
    """A cheaper product: rows [*batch, R, K] times a matrix [*batch, K, C].

    ``axes`` are the sizes of the rows' operand, without axes that are 1 in both;
    ``order`` moves the ``batch`` axes that remain to the front. ``turned`` is True if
    the matrix is the left operand, which is then transposed.
    """

    rows: ir.Value
    axes: Shape
    order: tuple[int, ...]
    batch: int
    matrix: ir.Value
    matrix_shape: Shape
    turned: bool

    @property
    def sorted_axes(self) -> Shape:
        """The sizes of the rows' axes in their new order."""
        return tuple(self.axes[axis] for axis in self.order)

    @property
    def rows_shape(self) -> Shape:
        """The shape of the rows, [*batch, R, K]."""
        *sizes, width = self.sorted_axes
        return (*sizes[: self.batch], math.prod(sizes[self.batch :]), width)

    @property
    def shape(self) -> Shape:
        """The shape of the product, [*batch, R, C]."""
        batch = np.broadcast_shapes(self.rows_shape[:-2], self.matrix_shape[:-2])
        return (*batch, self.rows_shape[-2], self.matrix_shape[-1])

    @property
    def moves(self) -> bool:
        """Whether rows are transposed, and the product is transposed back."""
        return list(self.order) != sorted(self.order)

    @property
    def price(self) -> float:
        """The cost of its views, transpositions and products, in node starts."""
        starts = small_products(self.rows_shape, self.matrix_shape)
        price, moved = 3.0 + starts / SMALL_PRODUCTS_PER_NODE, 0.0
        if self.turned:
            price, moved = price + 1.0, float(value_bytes(self.matrix) or 0)
        if self.moves:
            rows = value_bytes(self.rows) or 0
            share = math.prod(self.shape) / math.prod(self.rows_shape)
            price, moved = price + 2.0, moved + rows * (1.0 + share)
        return price + 2 * moved / MOVED_BYTES_PER_NODE


def _flatten(call: FusedCall) -> ir.Node | None:
    """Write a product in its cheapest form; return the new one, None if none pays."""
    product = call.node
    shapes, (left, right) = _shapes(product), product.inputs[:2]
    if shapes is None or left is None or right is None:
        return None
    # Rows of the left operand, or the right operand's vectors as rows; of the batch
    # axes that the matrix lacks, the last ones or all become rows
    ways = [(left, shapes[0], right, shapes[1], False)]
    if shapes[1][-1] == 1:
        ways.append((right, _turned(shapes[1]), left, _turned(shapes[0]), True))
    forms = [_form(*way, all_axes=every) for way in ways for every in (False, True)]
    best = min(filter(None, forms), key=lambda form: form.price, default=None)
    now = small_products(*shapes) / SMALL_PRODUCTS_PER_NODE
    return None if best is None or best.price >= now else _write(call, best)


def _form(
    rows: ir.Value,
    rows_shape: Shape,
    matrix: ir.Value,
    matrix_shape: Shape,
    turned: bool,
    *,
    all_axes: bool,
) -> _Form | None:
    """Return the form in which rows take all batch axes that can be rows, or the last.

    None where no batch axis can become rows.
    """
    # Pair the batch axes of both operands: [*lead, R, K] and [*shared, K, C]
    rank = max(len(rows_shape), len(matrix_shape))
    *lead, count, width = _widened(rows_shape, rank)
    shared = _widened(matrix_shape, rank)[:-2]
    pairs = [pair for pair in zip(lead, shared, strict=True) if max(pair) > 1]
    last = next((n for n, (_, size) in enumerate(reversed(pairs)) if size > 1), None)
    end = 0 if last is None else len(pairs) - last
    # Axes that the matrix has stay a batch; the others become rows
    kept = [n for n, (_, m) in enumerate(pairs) if m > 1 or (n < end and not all_axes)]
    if len(kept) == len(pairs):
        return None
    others = [n for n in range(len(pairs)) if n not in kept]
    axes = (*(one for one, _ in pairs), count, width)
    order = (*kept, *others, len(pairs), len(pairs) + 1)
    sizes = (*(pairs[n][1] for n in kept), *matrix_shape[-2:])
    return _Form(rows, axes, order, len(kept), matrix, sizes, turned)


def _view(call: FusedCall, value: ir.Value, shape: Shape) -> ir.Value:
    """Reshape a value; a constant that nothing else reads is stored in that shape."""
    owned = len(value.uses()) == 1 and not value.is_graph_output()
    if owned and static_shape(value) != shape:
        return call.reshape_table(value, shape)
    return call.view(value, shape)


def _write(call: FusedCall, form: _Form) -> ir.Node:
    old, rows = call.node.outputs[0], form.rows
    # Write both operands as they are multiplied
    if form.moves:
        rows = call.transpose(_view(call, rows, form.axes), form.order)
    rows = _view(call, rows, form.rows_shape)
    shape = _turned(form.matrix_shape) if form.turned else form.matrix_shape
    matrix = _view(call, form.matrix, shape)
    if form.turned:
        rank = len(shape)
        matrix = call.transpose(matrix, (*range(rank - 2), rank - 1, rank - 2))
    new = call.add("MatMul", [rows, matrix])
    node = new.producer()
    assert node is not None
    # Bring the product back to its old shape
    if form.moves:
        sizes = (*form.sorted_axes[form.batch : -1], form.shape[-1])
        new = call.view(new, (*form.shape[: form.batch], *sizes))
        back = [form.order.index(axis) for axis in range(len(form.order))]
        new = call.transpose(new, back)
    replace(call, call.view(new, static_shape(old) or ()))
    return node


def _read_unrepeated(call: FusedCall) -> int:
    """Bypass repetitions of operands that the product broadcasts; count them."""
    product, count = call.node, 0
    for index in (0, 1):
        shapes, value = _shapes(product), product.inputs[index]
        if shapes is None or value is None:
            continue
        repeated = repeated_axes(value)
        if repeated is None or repeated.large != shapes[index]:
            continue
        # The product must broadcast the small operand to the same batch
        small = repeated.small
        pair = (small, shapes[1]) if index == 0 else (shapes[0], small)
        batch = np.broadcast_shapes(*(shape[:-2] for shape in pair))
        same = batch == np.broadcast_shapes(*(shape[:-2] for shape in shapes))
        if small[-2:] == shapes[index][-2:] and same:
            product.replace_input_with(index, _view(call, repeated.source, small))
            remove_unread([value])
            count += 1
    return count


def _shapes(product: ir.Node) -> tuple[Shape, Shape] | None:
    """Return the shapes of both operands of a product of matrices, none empty."""
    left, right = map(static_shape, product.inputs[:2])
    if left is None or right is None or static_shape(product.outputs[0]) is None:
        return None
    if min(len(left), len(right)) < 2 or 0 in (*left, *right):
        return None
    return left, right


def _widened(shape: Shape, rank: int) -> Shape:
    return (1,) * (rank - len(shape)) + shape


def _turned(shape: Shape) -> Shape:
    return (*shape[:-2], shape[-1], shape[-2])
