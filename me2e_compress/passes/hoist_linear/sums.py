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
from typing import Self, TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, is_standard, static_shape
from me2e_compress.graph.nodes import (
    FLOATS,
    LAYOUT_OPERATORS,
    Numbers,
    holds_numbers,
    maker,
    numbers_of,
    overflow,
    permutation_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import remove_unread
from me2e_compress.operators import FusedCall
from me2e_compress.passes.work import BYTES_PER_NODE, MACS_PER_NODE, item_bytes

# Largest number of consecutive nodes examined before a product.
DEEPEST = 32


@dataclasses.dataclass(frozen=True)
class LinearLayer:
    """``source @ weight + bias``: a MatMul, and the Add of a constant vector.

    ``source`` [..., K] are the rows, ``weight`` [K, N] is a constant matrix.
    """

    product: ir.Node
    sum: ir.Node | None
    source: ir.Value
    weight: ir.Value

    @classmethod
    def of(cls, product: ir.Node, total: ir.Node | None = None) -> Self:
        """Return the layer of a product (:func:`is_product`), and of its bias."""
        source, weight = product.inputs
        assert source is not None
        assert weight is not None
        return cls(product, total, source, weight)

    @property
    def result(self) -> ir.Value:
        """The output, [..., N]."""
        return self.nodes[-1].outputs[0]

    @property
    def nodes(self) -> tuple[ir.Node, ...]:
        """Its nodes, the product first."""
        return (self.product,) if self.sum is None else (self.product, self.sum)

    def bias(self) -> list[Numbers]:
        """Return the added vector, [N], if there is one."""
        if self.sum is None:
            return []
        columns = (static_shape(self.result) or ())[-1:]
        added = next(value for value in self.sum.inputs if holds_numbers(value))
        return [np.array(np.broadcast_to(_known(added).reshape(-1), columns))]


def layer_at(product: ir.Node) -> LinearLayer | None:
    """Return the layer of a product, with its bias where nothing else reads it."""
    if not is_product(product):
        return None
    reader = sole_reader(product.outputs[0])
    if reader is not None and reader.op_type == "Add" and _adds_bias(reader, product):
        return LinearLayer.of(product, reader)
    return LinearLayer.of(product)


def layer_behind(value: ir.Value) -> LinearLayer | None:
    """Return the layer that computes a value."""
    node = maker(value, "MatMul", "Add")
    if node is None or node.op_type != "Add":
        return None if node is None or not is_product(node) else LinearLayer.of(node)
    for operand in node.inputs:
        product = maker(operand, "MatMul")
        if product is not None and is_product(product) and _adds_bias(node, product):
            return LinearLayer.of(product, node)
    return None


def is_product(node: ir.Node) -> bool:
    """Return whether a node multiplies rows by a constant matrix."""
    if node.op_type != "MatMul" or not is_standard(node):
        return False
    rows, result = static_shape(node.inputs[0]), static_shape(node.outputs[0])
    if not rows or not result or 0 in rows or node.outputs[0].dtype not in FLOATS:
        return False
    weight = node.inputs[1]
    if len(static_shape(weight) or ()) != 2 or not holds_numbers(weight):
        return False
    return array_of(node.inputs[0]) is None


def _adds_bias(node: ir.Node, product: ir.Node) -> bool:
    """Return whether an Add adds a constant vector to a product, and nothing else."""
    value, result = product.outputs[0], static_shape(product.outputs[0])
    others = [operand for operand in node.inputs if operand is not value]
    if result is None or len(others) != 1 or static_shape(node.outputs[0]) != result:
        return False
    shape = static_shape(others[0])
    if shape is None or not holds_numbers(others[0]) or len(shape) > len(result):
        return False
    return math.prod(shape[:-1]) == 1 and (not shape or shape[-1] in (1, result[-1]))


def _known(value: ir.Value | None) -> Numbers:
    numbers = numbers_of(value)
    assert numbers is not None
    return numbers


# What adds up to a product: values of the graph, and constant rows [.., N].
Terms: TypeAlias = list[ir.Value | Numbers]


@dataclasses.dataclass(frozen=True)
class Form:
    """A way to multiply a value by a matrix of so many columns."""

    macs: int  # per frame, less those of layers that go with it
    cost: float  # the same in node starts, with nodes and bytes that are new
    write: Callable[[Numbers], Terms]  # writes the nodes for a matrix


def multiply_earlier(layer: LinearLayer, call: FusedCall) -> bool:
    """Write a layer in its cheapest form; False if it has that.

    ``call`` is of the last node of the layer.
    """
    search = _Search(layer, call)
    source = layer.source
    now, best = search.direct(source), search.of(source, owned=True, depth=DEEPEST)
    if now.cost - best.cost < 1.0 or best.macs >= now.macs:
        return False
    # Write it, unless a product of two matrices is too large for its type
    matrix = _known(layer.weight)
    search.stored[id(matrix)] = matrix, layer.weight
    try:
        terms = [*best.write(matrix), *layer.bias()]
        new = search.total(terms, static_shape(layer.result) or ())
    except OverflowError:
        remove_unread(reversed(search.written))
        return False
    replace(call, new)
    return True


def replace(call: FusedCall, new: ir.Value) -> None:
    """Put a value in the place of a node's, and remove what only that node needed."""
    read = call.node.inputs
    call.put(new)
    remove_unread(read)


class _Search:
    """Finds and writes the forms of one layer's product."""

    def __init__(self, layer: LinearLayer, call: FusedCall) -> None:
        self.result, self.call = layer.result, call
        call.sources = layer.nodes
        self.columns = (static_shape(layer.result) or (0,))[-1]
        self.item_cost = item_bytes(layer.result) / BYTES_PER_NODE
        self.known: dict[ir.Value, Form] = {}
        self.stored: dict[int, tuple[Numbers, ir.Value]] = {}
        self.written: list[ir.Value] = []

    def of(self, value: ir.Value, *, owned: bool, depth: int) -> Form:
        """Return the cheapest form; ``owned``: only this product needs its reader."""
        # As it is, or by each line of the algebra that fits its maker
        if value not in self.known:
            owned = owned and sole_reader(value) is not None
            forms = [self.direct(value, owned=owned)]
            node = value.producer()
            if depth and node is not None and node.graph is self.call.node.graph:
                for rule in (self._two_layers, self._over_sum, self._before_view):
                    form = rule(value, node, owned, depth - 1)
                    forms.extend(() if form is None else (form,))
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
            return [self._write("MatMul", value, self._stored(matrix, "weight"))]

        return Form(macs, 1.0 + macs / MACS_PER_NODE, write)

    def _two_layers(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply the source: (x V + c) W = x (V W) + c W."""
        layer = layer_behind(value)
        if layer is None:
            return None
        # V W is [rows[-1], columns]; the first layer goes if nothing else reads it
        owned = owned and all(sole_reader(node.outputs[0]) for node in layer.nodes)
        inner = self.of(layer.source, owned=owned, depth=depth)
        rows = static_shape(layer.source) or (1,)
        width = (static_shape(value) or (1,))[-1]
        gone = owned * math.prod(rows) * width
        cost = inner.cost + rows[-1] * self.columns * self.item_cost
        cost -= owned * len(layer.nodes) + gone / MACS_PER_NODE

        def write(matrix: Numbers) -> Terms:
            self.call.sources += layer.nodes
            terms = inner.write(_known(layer.weight) @ matrix)
            return [*terms, *(bias @ matrix for bias in layer.bias())]

        return Form(inner.macs - gone, cost, write)

    def _over_sum(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply the terms: (x + y) W = x W + y W, and (x - y) W = x W + y (-W)."""
        shape = static_shape(value)
        if node.op_type not in ("Add", "Sub") or not is_standard(node) or not shape:
            return None
        terms = [term for term in node.inputs if term is not None]
        rows = [static_shape(term) or () for term in terms if not holds_numbers(term)]
        if any(row[-1:] != shape[-1:] for row in rows):
            return None
        # The Add is needed as before; a layer or a constant among the terms takes W in
        one, two = (self.of(term, owned=owned, depth=depth) for term in terms)
        minus = node.op_type == "Sub"
        cost = one.cost + two.cost + (not owned)
        cost += minus * shape[-1] * self.columns * self.item_cost

        def write(matrix: Numbers) -> Terms:
            self.call.sources += (node,)
            return [*one.write(matrix), *two.write(-matrix if minus else matrix)]

        return Form(one.macs + two.macs, cost, write)

    def _before_view(
        self, value: ir.Value, node: ir.Node, owned: bool, depth: int
    ) -> Form | None:
        """Multiply in front of a view of the same rows: view(x) W = view(x W)."""
        # A view of the same rows: the last axis must stay the last
        source, shape = node.inputs[0] if node.inputs else None, static_shape(value)
        inner = static_shape(source)
        if not shape or not inner or source is None or inner[-1] != shape[-1]:
            return None
        if node.op_type not in LAYOUT_OPERATORS or not is_standard(node):
            return None
        order = permutation_of(node) if node.op_type == "Transpose" else None
        if node.op_type == "Transpose" and (not order or order[-1] != len(order) - 1):
            return None
        # The same view of the product, [.., columns]
        source_form = self.of(source, owned=owned, depth=depth)

        def write(matrix: Numbers) -> Terms:
            self.call.sources += (node,)
            rows = self.total(source_form.write(matrix), (*inner[:-1], self.columns))
            if order is not None:
                self.written.append(self.call.transpose(rows, order))
            else:
                self.written.append(self.call.view(rows, (*shape[:-1], self.columns)))
            return [self.written[-1]]

        return Form(source_form.macs, source_form.cost + (not owned), write)

    def total(self, terms: Terms, shape: tuple[int, ...]) -> ir.Value:
        """Write a sum, its terms of the fewest rows first; these take the vectors."""
        # A single row broadcasts as a vector, and is added to the next constant
        arrays = sorted((a for a in terms if not isinstance(a, ir.Value)), key=np.size)
        rows = [a.reshape(-1) if a.size == a.shape[-1] else a for a in arrays]
        while len(rows) > 1 and rows[0].ndim == 1:
            rows = [rows[0] + rows[1], *rows[2:]]
        values = [term for term in terms if isinstance(term, ir.Value)]
        items = [*values, *(self._stored(row, "sum") for row in rows)]
        items.sort(key=lambda item: math.prod(static_shape(item) or ()))
        if len(items) > 1 and items[0].is_initializer():
            items[:2] = items[1], items[0]
        first, *rest = items
        for item in rest:
            first = self._write("Add", first, item)
        return self.call.view(first, shape)

    def _write(self, op_type: str, *inputs: ir.Value) -> ir.Value:
        self.written.append(self.call.add(op_type, inputs))
        return self.written[-1]

    def _stored(self, numbers: Numbers, name: str) -> ir.Value:
        """Return the initializer of a matrix or of constant rows."""
        if id(numbers) not in self.stored:
            dtype = self.result.dtype
            assert dtype is not None
            with np.errstate(over="ignore"):
                array = numbers.astype(dtype.numpy())
            if overflow(numbers, array):
                raise OverflowError(name)
            value = self.call.constant(array, name)
            self.stored[id(numbers)] = numbers, value
        return self.stored[id(numbers)][1]


def _constant(value: ir.Value, matrix: Numbers) -> Terms:
    """Multiply constant rows; one column is that of all."""
    numbers = _known(value)
    rows = np.broadcast_to(numbers, (*numbers.shape[:-1], len(matrix)))
    return [rows @ matrix]
