"""Write the views and products that take the place of one node."""

from collections.abc import Sequence

import onnx_ir as ir

from me2e_compress.graph import static_shape
from me2e_compress.graph.rewrite import Array
from me2e_compress.passes.hoist_linear.rebuilding import Rewriter


class NodeWriter:
    """Writes nodes of known shapes in front of the node that they replace.

    Args:
        rewriter: of the graph.
        sources: the replaced node first, then those that go with it.
        label: what shapes are named after; None for the replaced node.
    """

    def __init__(
        self, rewriter: Rewriter, sources: Sequence[ir.Node], label: str | None = None
    ) -> None:
        self.rewriter, self.sources = rewriter, tuple(sources)
        self.label = self.sources[0].name if label is None else label
        self.values: list[ir.Value] = []

    @property
    def nodes(self) -> list[ir.Node]:
        """The nodes written so far."""
        made = (value.producer() for value in self.values)
        return [node for node in made if node is not None]

    def undo(self) -> None:
        """Remove what was written."""
        self.rewriter.undo(self.values)

    def transpose(self, value: ir.Value, order: Sequence[int]) -> ir.Value:
        """Reorder axes; nothing is written where the order stays."""
        if list(order) == sorted(order):
            return value
        old = static_shape(value) or ()
        shape = tuple(old[axis] for axis in order)
        perm = ir.AttrInt64s("perm", list(order))
        return self._moved(value, self.write("Transpose", [value], shape, [perm]))

    def shape(self, value: ir.Value, shape: tuple[int, ...]) -> ir.Value:
        """Reshape; nothing is written where the shape stays."""
        if static_shape(value) == shape:
            return value
        target = self.rewriter.target(shape, f"{self.label}_shape")
        return self._moved(value, self.write("Reshape", [value, target], shape))

    def _moved(self, value: ir.Value, result: ir.Value) -> ir.Value:
        result.type = value.type or result.type
        return result

    def multiply(self, left: ir.Value, right: ir.Value) -> ir.Value:
        """Multiply matrices; the axes before the last two are those of the left."""
        rows, columns = static_shape(left) or (), static_shape(right) or ()
        return self.write("MatMul", [left, right], (*rows[:-1], *columns[-1:]))

    def plus(self, one: ir.Value | None, two: ir.Value) -> ir.Value:
        """Add a value that broadcasts to the first, which may not be there yet."""
        if one is None:
            return two
        return self.write("Add", [one, two], static_shape(one) or ())

    def constant(self, numbers: Array, name: str) -> ir.Value:
        """Store a constant of the type of the replaced node's output."""
        dtype = self.sources[0].outputs[0].dtype
        assert dtype is not None
        name = f"{self.sources[0].name}_{name}"
        return self.rewriter.store(numbers.astype(dtype.numpy()), name)

    def write(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        shape: tuple[int, ...],
        attributes: Sequence[ir.Attr] = (),
    ) -> ir.Value:
        """Write a node of one output."""
        value = self.rewriter.write(
            op_type,
            inputs,
            attributes,
            shape,
            sources=self.sources,
            like=self.sources[0].outputs[0],
        )
        self.values.append(value)
        return value
