"""Rows that are the same for every entry of an axis, and how to write them once.

Given:   Transpose(Concat(Reshape(Tile(x)), C)), all rows of C equal along the axis

Result:  Transpose(Concat(Reshape(x), C[:1]))
"""

import dataclasses
import math

import onnx_ir as ir

from me2e_compress.graph import is_standard, static_shape
from me2e_compress.graph.nodes import VIEWS, permutation_of
from me2e_compress.graph.rewrite import holds_numbers, numbers_of, sole_reader
from me2e_compress.passes.hoist_linear.node_writer import NodeWriter
from me2e_compress.passes.hoist_linear.row_moves import broadcasts


@dataclasses.dataclass(frozen=True)
class Shared:
    """A value whose entries along an axis are all equal.

    ``parts`` are the inputs of its maker, shared along their own axes; a value without
    parts has one entry there, or is a constant.
    """

    value: ir.Value
    axis: int
    parts: tuple["Shared", ...] = ()

    @property
    def shape(self) -> tuple[int, ...]:
        """The shape with one entry along the axis."""
        shape = static_shape(self.value) or ()
        return (*shape[: self.axis], 1, *shape[self.axis + 1 :])

    @property
    def nodes(self) -> tuple[ir.Node, ...]:
        """The makers that are not needed any more where this value is not."""
        node = self.value.producer()
        if not self.parts or node is None or sole_reader(self.value) is None:
            return ()
        return (node, *(each for part in self.parts for each in part.nodes))

    def write(self, writer: NodeWriter) -> ir.Value:
        """Write the value with one entry along the axis."""
        node = self.value.producer()
        if not self.parts or node is None:
            return self._first(writer)
        parts = [part.write(writer) for part in self.parts]
        if node.op_type in VIEWS or static_shape(parts[0]) == self.shape:
            return writer.shape(parts[0], self.shape)
        if node.op_type in ("Expand", "Tile"):
            target = writer.rewriter.target(self.shape, f"{self.value.name}_shape")
            return writer.write("Expand", [parts[0], target], self.shape)
        attributes = list(node.attributes.values())
        return writer.write(node.op_type, parts, self.shape, attributes)

    def _first(self, writer: NodeWriter) -> ir.Value:
        if static_shape(self.value) == self.shape:
            return self.value
        numbers = numbers_of(self.value)
        assert numbers is not None
        return writer.constant(
            numbers.take([0], self.axis), self.value.name or "constant"
        )


def shared_along(value: ir.Value | None, axis: int) -> Shared | None:
    """Return how to write a value once along an axis; None if entries may differ."""
    shape = static_shape(value)
    if value is None or shape is None or not 0 <= axis < len(shape):
        return None
    if shape[axis] == 1:
        return Shared(value, axis)
    if holds_numbers(value):
        numbers = numbers_of(value)
        equal = numbers is not None and (numbers == numbers.take([0], axis)).all()
        return Shared(value, axis) if equal else None
    # Otherwise its maker repeats entries, or moves some that are equal
    node = value.producer()
    if node is None or node.graph is not value.graph or not is_standard(node):
        return None
    sources = [each for each in node.inputs if each is not None]
    inner = _inner_axis(node, axis, shape)
    if inner is None:
        return None
    count = len(sources) if node.op_type == "Concat" else 1
    parts = [shared_along(each, inner) for each in sources[:count]]
    known = tuple(part for part in parts if part is not None)
    return Shared(value, axis, known) if len(known) == count else None


def _inner_axis(node: ir.Node, axis: int, shape: tuple[int, ...]) -> int | None:
    """Return the axis of a node's inputs that becomes an axis of its output."""
    source = static_shape(node.inputs[0])
    if source is None:
        return None
    if node.op_type == "Transpose":
        order = permutation_of(node)
        return None if order is None else order[axis]
    if node.op_type == "Concat":
        joined = node.attributes.get_int("axis", 0) % len(shape)
        return None if joined == axis else axis
    if broadcasts(node):
        return axis - (len(shape) - len(source))
    if node.op_type not in VIEWS:
        return None
    # A view keeps an axis that has as many entries before it as before
    before = math.prod(shape[:axis])
    kept = (at for at, size in enumerate(source) if size == shape[axis])
    return next((at for at in kept if math.prod(source[:at]) == before), None)
