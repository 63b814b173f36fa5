"""Write new nodes into a graph, and drop what nothing reads any more."""

from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.nodes import Array, is_read
from me2e_compress.graph.provenance import inherit
from me2e_compress.graph.rewrite import (
    add_constant,
    fresh_name,
    remove_node,
    replace_value,
)


class Rewriter:
    """Rewrites a graph or body; ``names`` holds all value names of the model."""

    def __init__(self, graph: ir.Graph, names: set[str], by: str) -> None:
        self.graph, self.names, self.by = graph, names, by
        self.shapes: dict[tuple[int, ...], ir.Value] = {}
        self.stored: list[ir.Value] = []

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


class NodeWriter:
    """Writes nodes of known shapes in front of the node that they replace.

    Args:
        rewriter: of the graph.
        node: that one; new values have its result's type.
        label: what shapes are named after.
        sources: the nodes that the new ones stand for, by default that one.
    """

    def __init__(
        self,
        rewriter: Rewriter,
        node: ir.Node,
        label: str | None,
        sources: Sequence[ir.Node] = (),
    ) -> None:
        self.rewriter, self.node, self.label = rewriter, node, label
        self.sources = tuple(sources) or (node,)
        self.values: list[ir.Value] = []

    def transpose(self, value: ir.Value, order: Sequence[int]) -> ir.Value:
        """Reorder axes; nothing is written where the order stays."""
        if list(order) == sorted(order):
            return value
        old = static_shape(value) or ()
        shape = tuple(old[axis] for axis in order)
        perm = ir.AttrInt64s("perm", list(order))
        result = self.write("Transpose", [value], shape, [perm])
        result.type = value.type or result.type
        return result

    def shape(
        self, value: ir.Value, shape: tuple[int, ...], op_type: str = "Reshape"
    ) -> ir.Value:
        """Reshape, or Expand; nothing is written where the shape stays."""
        if static_shape(value) == shape:
            return value
        target = self.rewriter.target(shape, f"{self.label}_shape")
        result = self.write(op_type, [value, target], shape)
        result.type = value.type or result.type
        return result

    def write(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        shape: tuple[int, ...],
        attributes: Sequence[ir.Attr] = (),
    ) -> ir.Value:
        """Write a node of one output."""
        names = self.rewriter.names
        name = fresh_name(f"{self.sources[0].name}_{op_type}", names)
        node = ir.Node("", op_type, inputs, attributes, num_outputs=1, name=name)
        value, kind = node.outputs[0], self.node.outputs[0].type
        value.name, value.type, value.shape = name, kind, ir.Shape(shape)
        inherit(node, self.sources, by=self.rewriter.by)
        self.rewriter.graph.insert_before(self.node, node)
        self.values.append(value)
        return value
