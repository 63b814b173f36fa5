"""Multiply earlier: two layers into one, and a layer over a sum.

With rows x and y, matrices V [K, M] and W [M, N], vectors c and d, constant rows T:

    (x V + c) W + d  =  x (V W) + (c W + d)       two layers into one
    (x + T) W + d    =  x W + (T W + d)           over a constant term
    (x + y V) W + d  =  x W + y (V W) + d         over a layer, by the first line
    (x - y) W        =  x W + y (-W)
    view(x) W        =  view(x W)                 a view keeps the last axis

V W, c W and T W are numbers that are stored. A term x of fewer rows than the sum, or of
fewer columns K than M, is multiplied for less; the addition repeats it as before.
"""

import dataclasses
import math
from collections.abc import Callable
from functools import partial

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import is_standard, static_shape
from me2e_compress.graph.nodes import LAYOUT_OPERATORS, permutation_of
from me2e_compress.graph.rewrite import (
    Numbers,
    holds_numbers,
    numbers_of,
    overflow,
    sole_reader,
)
from me2e_compress.passes.hoist_linear.layers import LinearLayer, layer_behind
from me2e_compress.passes.hoist_linear.rebuilding import NodeWriter, Rewriter
from me2e_compress.passes.work import MACS_PER_NODE, item_bytes

DEEPEST = 32
"""Largest number of consecutive nodes examined before a product."""


@dataclasses.dataclass(frozen=True)
class Terms:
    """What adds up to a product: values of the graph, and constant rows [.., N]."""

    values: tuple[ir.Value, ...] = ()
    constants: tuple[Numbers, ...] = ()

    def plus(self, vector: Numbers | None) -> "Terms":
        """Add a vector, if there is one."""
        more = () if vector is None else (vector,)
        return Terms(self.values, (*self.constants, *more))


@dataclasses.dataclass(frozen=True)
class Form:
    """A way to multiply a value by a matrix of so many columns.

    Attributes:
        macs: multiply-accumulates per frame, less those of layers that go with it.
        cost: the same in node starts, with nodes and bytes that are new.
        write: writes the nodes for a matrix.
    """

    macs: int
    cost: float
    write: Callable[[Numbers], Terms]


def multiply_earlier(
    layer: LinearLayer, rewriter: Rewriter, bytes_per_node: int
) -> bool:
    """Write a layer in its cheapest form; False if it has that."""
    search = _Search(layer, rewriter, bytes_per_node)
    source = layer.source
    now, best = search.direct(source), search.of(source, owned=True, depth=DEEPEST)
    if now.cost - best.cost < 1.0 or best.macs >= now.macs:
        return False
    # Write it, unless a product of two matrices is too large for its type
    matrix, vector = layer.matrix(), layer.bias()
    if layer.is_plain:
        search.stored[id(matrix)] = matrix, layer.weight
    try:
        terms = best.write(matrix).plus(vector)
        new = search.total(terms, static_shape(layer.result) or ())
    except OverflowError:
        rewriter.undo(search.writer.values)
        return False
    rewriter.swap(layer.result, new)
    return True


class _Search:
    """Finds and writes the forms of one layer's product."""

    def __init__(
        self, layer: LinearLayer, rewriter: Rewriter, bytes_per_node: int
    ) -> None:
        self.result, self.rewriter = layer.result, rewriter
        self.columns = (static_shape(layer.result) or (0,))[-1]
        self.item_cost = item_bytes(layer.result) / max(bytes_per_node, 1e-9)
        self.known: dict[ir.Value, Form] = {}
        self.stored: dict[int, tuple[Numbers, ir.Value]] = {}
        self.writer = NodeWriter(rewriter, layer.nodes, layer.result.name)

    def of(self, value: ir.Value, *, owned: bool, depth: int) -> Form:
        """Return the cheapest form; ``owned``: only this product needs its reader."""
        if value not in self.known:
            owned = owned and sole_reader(value) is not None
            forms = [self.direct(value, owned=owned)]
            node = value.producer()
            if depth and node is not None and node.graph is self.rewriter.graph:
                for rule in (self._two_layers, self._over_sum, self._before_view):
                    found = rule(value, node, owned, depth - 1)
                    forms.extend(() if found is None else (found,))
            self.known[value] = min(forms, key=lambda form: form.cost)
        return self.known[value]

    def direct(self, value: ir.Value, *, owned: bool = False) -> Form:
        """Multiply a value as it is; the product of a constant is stored instead."""
        shape = static_shape(value) or ()
        size = math.prod(shape[:-1]) * self.columns
        if holds_numbers(value):
            more = size - owned * math.prod(shape)
            return Form(0, more * self.item_cost, partial(_constant, value))
        macs = math.prod(shape) * self.columns

        def write(matrix: Numbers) -> Terms:
            inputs, rows = [value, self._stored(matrix, "weight")], shape[:-1]
            new = self.writer.write("MatMul", inputs, (*rows, self.columns))
            return Terms((new,))

        return Form(macs, 1.0 + macs / MACS_PER_NODE, write)

    def _two_layers(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply the source: (x V + c) W = x (V W) + c W."""
        layer = layer_behind(value)
        if layer is None:
            return None
        owned = owned and all(sole_reader(each.outputs[0]) for each in layer.nodes)
        inner = self.of(layer.source, owned=owned, depth=depth)
        rows = static_shape(layer.source) or (1,)
        width = (static_shape(value) or (1,))[-1]
        gone = owned * math.prod(rows) * width
        cost = inner.cost + rows[-1] * self.columns * self.item_cost
        cost -= owned * len(layer.nodes) + gone / MACS_PER_NODE

        def write(matrix: Numbers) -> Terms:
            self.writer.sources += layer.nodes
            bias = layer.bias()
            terms = inner.write(layer.matrix() @ matrix)
            return terms.plus(None if bias is None else bias @ matrix)

        return Form(inner.macs - gone, cost, write)

    def _over_sum(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply the terms: (x + y) W = x W + y W, and (x - y) W = x W + y (-W)."""
        shape = static_shape(value)
        if node.op_type not in ("Add", "Sub") or not is_standard(node) or not shape:
            return None
        terms = [each for each in node.inputs if each is not None]
        rows = [static_shape(each) or () for each in terms if not holds_numbers(each)]
        if any(each[-1:] != shape[-1:] for each in rows):
            return None
        one, two = (self.of(each, owned=owned, depth=depth) for each in terms)
        minus = node.op_type == "Sub"
        cost = one.cost + two.cost + (not owned)
        cost += minus * shape[-1] * self.columns * self.item_cost

        def write(matrix: Numbers) -> Terms:
            self.writer.sources += (node,)
            left, right = one.write(matrix), two.write(-matrix if minus else matrix)
            return Terms(left.values + right.values, left.constants + right.constants)

        return Form(one.macs + two.macs, cost, write)

    def _before_view(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply in front of a view of the same rows: view(x) W = view(x W)."""
        source, shape = node.inputs[0] if node.inputs else None, static_shape(value)
        inner = static_shape(source)
        if not shape or not inner or source is None or inner[-1] != shape[-1]:
            return None
        if node.op_type not in LAYOUT_OPERATORS or not is_standard(node):
            return None
        order = permutation_of(node) if node.op_type == "Transpose" else None
        if node.op_type == "Transpose" and (not order or order[-1] != len(order) - 1):
            return None
        found = self.of(source, owned=owned, depth=depth)

        def write(matrix: Numbers) -> Terms:
            self.writer.sources += (node,)
            rows = self.total(found.write(matrix), (*inner[:-1], self.columns))
            moved = (*shape[:-1], self.columns)
            if order is None:
                return Terms((self.writer.shape(rows, moved),))
            return Terms((self.writer.transpose(rows, order),))

        return Form(found.macs, found.cost + (not owned), write)

    def total(self, terms: Terms, shape: tuple[int, ...]) -> ir.Value:
        """Write a sum, its terms of the fewest rows first; these take the vectors."""
        # One row is added to the next smallest constant
        rows = sorted(map(_one_row, terms.constants), key=np.size)
        while len(rows) > 1 and rows[0].ndim == 1:
            rows = [rows[0] + rows[1], *rows[2:]]
        items = [*terms.values, *(self._stored(each, "sum") for each in rows)]
        items.sort(key=lambda each: math.prod(static_shape(each) or ()))
        if len(items) > 1 and items[0].is_initializer():
            items[:2] = items[1], items[0]
        first, *rest = items
        for item in rest:
            sizes = static_shape(first) or (), static_shape(item) or ()
            first = self.writer.write("Add", [first, item], np.broadcast_shapes(*sizes))
        return self.writer.shape(first, shape)

    def _stored(self, numbers: Numbers, name: str) -> ir.Value:
        """Return the initializer of a matrix or of constant rows."""
        if id(numbers) not in self.stored:
            dtype = self.result.dtype
            assert dtype is not None
            with np.errstate(over="ignore"):
                array = numbers.astype(dtype.numpy())
            if overflow(numbers, array):
                raise OverflowError(name)
            value = self.rewriter.store(array, f"{self.result.name}_{name}")
            self.stored[id(numbers)] = numbers, value
        return self.stored[id(numbers)][1]


def _constant(value: ir.Value, matrix: Numbers) -> Terms:
    """Multiply constant rows; one column is that of all."""
    numbers = numbers_of(value)
    assert numbers is not None
    rows = np.broadcast_to(numbers, (*numbers.shape[:-1], len(matrix)))
    return Terms((), (rows @ matrix,))


def _one_row(numbers: Numbers) -> Numbers:
    """Return a single row as a vector, which broadcasts as it does."""
    return numbers.reshape(-1) if numbers.size == numbers.shape[-1] else numbers
