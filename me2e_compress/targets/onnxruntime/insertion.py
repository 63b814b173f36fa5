"""Insert nodes at one place of a graph: shapes changed and restored."""

from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.targets.writer import Writer


class Place:
    """Inserts new nodes at one place, with the provenance of the old ones."""

    def __init__(
        self, writer: Writer, before: ir.Node, sources: Sequence[ir.Node]
    ) -> None:
        self._writer = writer
        self._before = before
        self._sources = sources

    def node(
        self,
        op: str,
        inputs: Sequence[ir.Value],
        name: str,
        attributes: dict[str, int] | None = None,
    ) -> ir.Node:
        """Insert a node; its output has the type of its first input."""
        node = self._writer.node(op, inputs, name, self._sources, attributes)
        if (kind := inputs[0].dtype) is not None:
            node.outputs[0].dtype = kind
        self._writer.graph.insert_before(self._before, node)
        return node

    def reshaped(self, value: ir.Value, shape: Sequence[int], name: str) -> ir.Value:
        """Reshape a value to a constant shape, of which one number may be -1."""
        target = self._writer.constant(np.array(shape, np.int64), f"{name}_shape")
        return self.node("Reshape", [value, target], name).outputs[0]

    def turned(self, value: ir.Value, axes: Sequence[int], name: str) -> ir.Value:
        """Transpose a value."""
        node = self.node("Transpose", [value], name)
        node.attributes.add(ir.AttrInt64s("perm", axes))
        return node.outputs[0]

    def restored(
        self,
        rows: ir.Value,
        like: ir.Value,
        leading: Sequence[int | ir.SymbolicDim],
        columns: int,
        name: str,
    ) -> ir.Value:
        """Reshape [rows, columns] to the leading dimensions of another value."""
        # At most one open dimension: a constant shape suffices.
        known = [dim if isinstance(dim, int) else -1 for dim in leading]
        if known.count(-1) <= 1:
            return self.reshaped(rows, [*known, columns], f"{name}_ranked")
        # Several open dimensions must be read at run time.
        numbers = [
            self._writer.constant(np.array([number], np.int64), f"{name}_end")
            for number in (0, -1, columns)
        ]
        whole = self.node("Shape", [like], f"{name}_dims").outputs[0]
        front = self.node("Slice", [whole, *numbers[:2]], f"{name}_leading").outputs[0]
        target = self.node("Concat", [front, numbers[2]], f"{name}_target", {"axis": 0})
        for value in (whole, front, target.outputs[0]):
            value.dtype = ir.DataType.INT64
        inputs = [rows, target.outputs[0]]
        return self.node("Reshape", inputs, f"{name}_ranked").outputs[0]
