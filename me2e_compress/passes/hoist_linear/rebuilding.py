"""Write another way to compute a linear layer into the graph."""

import math
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import VIEWS
from me2e_compress.graph.rewrite import (
    Array,
    Numbers,
    add_constant,
    fresh_name,
    inherit,
    is_read,
    overflow,
    remove_node,
    replace_value,
)
from me2e_compress.passes.hoist_linear.linear_layers import LinearLayer
from me2e_compress.passes.hoist_linear.matrices import Matrix, plus, times, vector_of
from me2e_compress.passes.hoist_linear.ways import (
    Composed,
    Direct,
    Distributed,
    Precomputed,
    Term,
    Way,
)


class Rewriter:
    """Rewrites a graph or body; ``names`` holds all value names of the model."""

    def __init__(self, graph: ir.Graph, names: set[str], by: str) -> None:
        self.graph, self.names, self.by = graph, names, by
        self.shapes: dict[tuple[int, ...], ir.Value] = {}
        self.stored: list[ir.Value] = []

    def replace(self, layer: LinearLayer, way: Way) -> bool:
        """Compute a layer another way; False if a weight would overflow."""
        writer = _Writer(self, layer)
        name = layer.weight.name or "weight"
        stored = layer.weight if layer.is_plain else None
        try:
            new = writer.build(way, Matrix(layer.matrix(), stored, name), layer.bias())
        except OverflowError:
            self.undo(writer.made)
            return False
        self.swap(layer.result, new)
        return True

    def swap(self, old: ir.Value, new: ir.Value) -> None:
        """Replace a value, keep its name, and drop what nothing reads any more."""
        name = old.name
        replace_value(old, new, self.names)
        self.drop(old)
        new.name = name

    def drop(self, value: ir.Value) -> None:
        """Remove the unread maker of a value, and all nodes that only it needed."""
        waiting = [value.producer()]
        while waiting:
            last = waiting.pop()
            if last is None or last.graph is not self.graph:
                continue
            if not any(map(is_read, last.outputs)):
                waiting.extend(last.predecessors())
                remove_node(last)

    def target(self, shape: tuple[int, ...], name: str) -> ir.Value:
        """Return the initializer that holds a shape, for a Reshape or Expand."""
        known = self.shapes.get(shape)
        if known is None or not known.is_initializer():
            array = np.array(shape, np.int64)
            known = self.shapes[shape] = self.store(array, name)
        return known

    def store(self, array: Array, name: str) -> ir.Value:
        """Register an initializer."""
        value = add_constant(self.graph, array, name, self.names)
        self.stored.append(value)
        return value

    def undo(self, values: Sequence[ir.Value]) -> None:
        """Remove the last written values, in order, and their constants."""
        for value in reversed(values):
            self.drop(value)
        for value in self.stored:
            if not is_read(value) and value.is_initializer():
                del self.graph.initializers[value.name or ""]

    def move(
        self, node: ir.Node, inputs: list[ir.Value]
    ) -> tuple[str, list[ir.Value | None], list[ir.Attr], tuple[int, ...]]:
        """Return operator, inputs, attributes and shape of a node on other rows."""
        width = (static_shape(inputs[0]) or (0,))[-1]
        shape = (*(static_shape(node.outputs[0]) or ())[:-1], width)
        if node.op_type in VIEWS or node.op_type == "Expand":
            kind = "Expand" if node.op_type == "Expand" else "Reshape"
            target = self.target(shape, f"{node.outputs[0].name}_shape")
            return kind, [inputs[0], target], [], shape
        given = [*inputs, *node.inputs[len(inputs) :]]
        return node.op_type, given, list(node.attributes.values()), shape

    def write(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Sequence[ir.Attr],
        shape: tuple[int, ...],
        *,
        sources: Sequence[ir.Node],
        like: ir.Value,
    ) -> ir.Value:
        """Write a node that replaces ``sources``, before the maker of ``like``."""
        place = like.producer()
        assert place is not None
        name = fresh_name(f"{sources[0].name}_{op_type}", self.names)
        node = ir.Node("", op_type, inputs, attributes, num_outputs=1, name=name)
        value = node.outputs[0]
        value.name, value.type, value.shape = name, like.type, ir.Shape(shape)
        inherit(node, sources, by=self.by)
        self.graph.insert_before(place, node)
        return value


class _Writer:
    def __init__(self, rewriter: Rewriter, layer: LinearLayer) -> None:
        self.rewriter, self.layer = rewriter, layer
        self.made: list[ir.Value] = []

    def build(self, way: Way, matrix: Matrix, bias: Numbers | None) -> ir.Value:
        return self._write_way(way, matrix, plus(bias, vector_of(way, matrix)))

    def _write_way(self, way: Way, matrix: Matrix, vector: Numbers | None) -> ir.Value:
        # Products and constants end the recursion
        if isinstance(way, Direct):
            return self._multiply(way.value, matrix, vector)
        if isinstance(way, Precomputed):
            return self._constant(times(way.value, matrix, vector), matrix.name)
        if isinstance(way, Composed):
            return self._write_way(way.way, matrix.behind(way), vector)
        if isinstance(way, Distributed):
            return self._distribute(way, matrix, vector)
        # A move: write each distinct part once
        if len(way.parts) == 1:
            parts = [self._write_way(way.parts[0], matrix, vector)]
        else:
            once = {id(part): part for part in way.parts}  # some stand there twice
            made = {key: self.build(part, matrix, vector) for key, part in once.items()}
            parts = [made[id(part)] for part in way.parts]
        return self._write(*self.rewriter.move(way.node, parts), also=way.node)

    def _distribute(
        self, way: Distributed, matrix: Matrix, vector: Numbers | None
    ) -> ir.Value:
        """Write the terms, the fewest rows first, which take the vector."""
        terms, minus = list(way.terms), way.node.op_type == "Sub"
        # Constant terms join the vector
        if not minus:
            terms.sort(key=lambda term: math.prod(term.shape[:-1]))
            terms, vector = _without_vectors(terms, matrix, vector)
        total: ir.Value | None = None
        # Only the first term takes the vector
        for term in terms:
            one = self._write_way(term.way, matrix.part(term), vector)
            vector = None
            if total is None:
                total = one
                continue
            shapes = (static_shape(total) or (), static_shape(one) or ())
            shape, kind = np.broadcast_shapes(*shapes), "Sub" if minus else "Add"
            total = self._write(kind, [total, one], [], shape, also=way.node)
        assert total is not None
        return total

    def _multiply(
        self, value: ir.Value, matrix: Matrix, vector: Numbers | None
    ) -> ir.Value:
        if matrix.value is None:
            matrix.value = self._constant(matrix.numbers, matrix.name)
        shape = (*(static_shape(value) or ())[:-1], matrix.numbers.shape[1])
        result = self._write("MatMul", [value, matrix.value], [], shape)
        if vector is None:
            return result
        bias = self._constant(vector, f"{matrix.name}_bias")
        return self._write("Add", [result, bias], [], shape)

    def _constant(self, numbers: Numbers, name: str) -> ir.Value:
        dtype = self.layer.result.dtype
        assert dtype is not None
        with np.errstate(over="ignore"):
            array = numbers.astype(dtype.numpy())
        if overflow(numbers, array):
            raise OverflowError(name)
        return self.rewriter.store(array, name)

    def _write(
        self,
        op_type: str,
        inputs: list[ir.Value] | list[ir.Value | None],
        attributes: list[ir.Attr],
        shape: tuple[int, ...],
        *,
        also: ir.Node | None = None,
    ) -> ir.Value:
        layer = self.layer
        sources = layer.nodes if also is None else (*layer.nodes, also)
        value = self.rewriter.write(
            op_type, inputs, attributes, shape, sources=sources, like=layer.result
        )
        self.made.append(value)
        return value


def _without_vectors(
    terms: list[Term], matrix: Matrix, vector: Numbers | None
) -> tuple[list[Term], Numbers | None]:
    """Merge constant terms of one row into the vector, if others have full shape."""
    kept = [
        term
        for term in terms
        if not isinstance(term.way, Precomputed) or math.prod(term.shape[:-1]) != 1
    ]
    full = np.broadcast_shapes(*(term.shape[:-1] for term in terms))
    if not kept or np.broadcast_shapes(*(term.shape[:-1] for term in kept)) != full:
        return terms, vector
    for term in terms:
        if term not in kept and isinstance(term.way, Precomputed):
            vector = times(term.way.value, matrix.part(term), vector).reshape(-1)
    return kept, vector
