"""Write nodes before one fused node, and put one of them in its place."""

import functools
import math
from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.graph import array_of, provenance
from me2e_compress.graph.nodes import Array
from me2e_compress.graph.rewrite import (
    add_constant,
    fresh_name,
    replace_value,
    value_names,
)
from me2e_compress.graph.shapes import REFUSALS, infer_node, static_shape

AttributeValue: TypeAlias = int | float | str | Sequence[int]
Attributes: TypeAlias = Mapping[str, AttributeValue]
# One dimension: a number, or an int64 value of shape [1] that holds it at run time
Size: TypeAlias = int | ir.Value


class FusedCall:
    """Inserts nodes before one fused node: its body, or its form in another dialect.

    New nodes inherit the module and origins of ``sources``, at first the fused node;
    their shape and type are inferred at once. ``names`` are those of all values of the
    model, to which new ones are added; None collects them from the whole graph, which
    is slow for many nodes. ``compiled`` allows calls of compiled kernels.
    """

    def __init__(
        self,
        node: ir.Node,
        *,
        opset: int,
        by: str,
        names: set[str] | None = None,
        compiled: bool = False,
    ) -> None:
        if node.graph is None:
            raise GraphError(f"node {node.name} is not in a graph")
        self.node, self.opset, self.by = node, opset, by
        self.compiled = compiled
        self.sources: tuple[ir.Node, ...] = (node,)
        self._where: ir.Graph | ir.Function = node.graph
        self.names = names_in(self._where) if names is None else names
        self._stem = node.name or str(node.outputs[0].name)

    def add(
        self,
        op_type: str,
        inputs: Sequence[ir.Value | None],
        attributes: Mapping[str, AttributeValue | ir.TensorProtocol] | None = None,
        *,
        domain: str = "",
        outputs: int = 1,
    ) -> ir.Value:
        """Insert a node before the fused one and return its first output.

        Raises:
            GraphError: an input is no value.
        """
        for index, value in enumerate(inputs):
            if value is not None and not isinstance(value, ir.Value):
                raise GraphError(
                    f"{op_type}: input {index} is {value!r}, not a value: write"
                    f" call.numbers({value!r}, like=x)"
                )
        name = fresh_name(f"{self._stem}/{op_type}", self.names)
        node = ir.node(
            op_type, inputs, attributes, domain=domain, name=name, num_outputs=outputs
        )
        for index, value in enumerate(node.outputs):
            value.name = fresh_name(f"{name}_{index}", self.names)
        # Shape and type are inferred at once
        provenance.inherit(node, self.sources, by=self.by)
        self._where.insert_before(self.node, node)
        _infer(node, self.opset)
        return node.outputs[0]

    def put(self, result: ir.Value) -> None:
        """Replace the fused node by a value, which gets the name of its output."""
        node, old = self.node, self.node.outputs[0]
        if result.producer() is None or result in node.inputs:
            result = self.add("Identity", [result])  # an output needs a node of its own
        # Keep the better type and shape, and the name
        if result.shape is None or not result.shape.is_static():
            result.shape = old.shape if old.shape is not None else result.shape
        result.type = result.type if result.type is not None else old.type
        name = old.name
        if isinstance(self._where, ir.Graph):
            replace_value(old, result, self.names)
        else:
            old.replace_all_uses_with(result, replace_graph_outputs=True)
        self._where.remove(node, safe=True)
        result.name = name

    def constant(self, array: Array, name: str = "constant") -> ir.Value:
        """Add a constant: an initializer, or a Constant node within a function."""
        name = f"{self._stem}/{name}"
        if isinstance(self._where, ir.Graph):
            return add_constant(self._where, array, name, self.names)
        node = ir.node("Constant", [], {"value": ir.tensor(array)}, num_outputs=1)
        node.name = node.outputs[0].name = fresh_name(name, self.names)
        self._where.insert_before(self.node, node)
        _infer(node, self.opset)
        return node.outputs[0]

    def numbers(
        self, values: float | Sequence[float] | Array, like: ir.Value
    ) -> ir.Value:
        """Add a constant of another value's element type."""
        kind = like.dtype or ir.DataType.FLOAT
        return self.constant(np.asarray(values, kind.numpy()))

    def integers(self, values: int | Sequence[int]) -> ir.Value:
        """Add an int64 constant."""
        return self.constant(np.asarray(values, np.int64), "sizes")

    def sizes(self, values: Sequence[Size], shape: Sequence[int] = (-1,)) -> ir.Value:
        """Return sizes as one int64 value, a constant where all are known."""
        known = [size for size in values if isinstance(size, int)]
        if len(known) == len(values):
            return self.constant(np.asarray(known, np.int64).reshape(shape), "sizes")
        joined = self.concat([self.value_of(size) for size in values], 0)
        return self.reshape(joined, shape)

    def reshape_table(self, value: ir.Value, shape: Sequence[int]) -> ir.Value:
        """Reshape a small table; a constant stays one."""
        known = array_of(value)
        if known is None:
            return self.reshape(value, shape)
        return self.constant(known.reshape(shape), "table")

    def cast(self, value: ir.Value, kind: ir.DataType) -> ir.Value:
        """Return a value in another element type; the value itself if it has that."""
        if value.dtype == kind:
            return value
        known = array_of(value)
        if known is not None:
            return self.constant(known.astype(kind.numpy()), "cast")
        return self.add("Cast", [value], {"to": int(kind)})

    def size(self, value: ir.Value, axis: int) -> Size:
        """Return the size of a dimension: a number where the graph knows it."""
        if (known := self.known_size(value, axis)) is not None:
            return known
        shown = self.add("Shape", [value])
        return self.add("Gather", [shown, self.integers([axis])], {"axis": 0})

    def known_size(self, value: ir.Value, axis: int) -> int | None:
        """Return the size of a dimension, if the graph knows it."""
        dim = None if value.shape is None else value.shape[axis]
        return dim if isinstance(dim, int) else None

    def value_of(self, size: Size) -> ir.Value:
        """Return a size as an int64 value of shape [1]."""
        return self.integers([size]) if isinstance(size, int) else size

    def product(self, *sizes: Size) -> Size:
        """Multiply sizes."""
        number = math.prod(size for size in sizes if isinstance(size, int))
        values = [size for size in sizes if not isinstance(size, int)]
        if not values:
            return number
        product = functools.reduce(lambda a, b: self.add("Mul", [a, b]), values)
        if number == 1:
            return product
        return self.add("Mul", [product, self.integers([number])])

    def reshape(self, value: ir.Value, sizes: Sequence[Size]) -> ir.Value:
        """Reshape to sizes, some possibly known only at run time; -1 is allowed."""
        known = [size for size in sizes if isinstance(size, int)]
        unknown = len(sizes) - len(known)
        # One size known only at run time may be left to -1
        if not unknown or (unknown == 1 and 0 not in known and -1 not in known):
            dims = [size if isinstance(size, int) else -1 for size in sizes]
            shape = self.integers(dims)
        else:
            shape = self.concat([self.value_of(size) for size in sizes], 0)
        # A literal 0 needs allowzero
        zero = 0 in known and -1 not in known and self.opset >= _ALLOWZERO_OPSET
        result = self.add("Reshape", [value, shape], {"allowzero": 1} if zero else None)
        if result.shape is None:
            result.shape = _shape(sizes)
        return result

    def view(self, value: ir.Value, shape: Sequence[int]) -> ir.Value:
        """Reshape a value, unless it has that shape."""
        if static_shape(value) == tuple(shape):
            return value
        return self.reshape(value, shape)

    def transpose(self, value: ir.Value, order: Sequence[int]) -> ir.Value:
        """Permute the axes of a value."""
        return self.add("Transpose", [value], {"perm": list(order)})

    def slice(self, value: ir.Value, start: int, end: int, axis: int) -> ir.Value:
        """Take the indices from start to end of one axis."""
        edges = [self.integers([number]) for number in (start, end, axis)]
        return self.add("Slice", [value, *edges])

    def counting(self, size: Size) -> ir.Value:
        """Write the int64 numbers 0, 1, ... below a size."""
        if isinstance(size, int):
            return self.integers(list(range(size)))
        end = self.add("Squeeze", [size, self.integers([0])])
        return self.add("Range", [self.integers(0), end, self.integers(1)])

    def concat(self, values: Sequence[ir.Value], axis: int) -> ir.Value:
        """Concatenate values along an axis; a single value is returned unchanged."""
        if len(values) == 1:
            return values[0]
        return self.add("Concat", values, {"axis": axis})

    def full(self, sizes: Sequence[Size], number: float, like: ir.Value) -> ir.Value:
        """Write a tensor of one number, of another value's element type."""
        kind = like.dtype or ir.DataType.FLOAT
        filling = {"value": ir.tensor(np.full(1, number, kind.numpy()))}
        result = self.add("ConstantOfShape", [self.sizes(sizes)], filling)
        result.shape = _shape(sizes)
        return result

    def split_last(self, value: ir.Value, count: int) -> tuple[ir.Value, ...]:
        """Return the components of the last axis as values of their own."""
        return tuple(
            self.add("Gather", [value, self.integers(index)], {"axis": -1})
            for index in range(count)
        )

    def sum(self, value: ir.Value, axes: Sequence[int]) -> ir.Value:
        """Sum over axes, which are dropped."""
        along = self.integers(list(axes))
        return self.add("ReduceSum", [value, along], {"keepdims": 0})

    def unsqueeze(self, value: ir.Value, axes: Sequence[int]) -> ir.Value:
        """Insert axes of size 1."""
        return self.add("Unsqueeze", [value, self.integers(list(axes))])


# Before this opset, a 0 in a shape copies the dimension of the input
_ALLOWZERO_OPSET = 14


def _shape(sizes: Sequence[Size]) -> ir.Shape:
    """Return a shape of sizes, those open that are not known or -1."""
    return ir.Shape([n if isinstance(n, int) and n >= 0 else None for n in sizes])


def names_in(where: ir.Graph | ir.Function) -> set[str]:
    """Return the names of all values of a graph or function."""
    if isinstance(where, ir.Graph):
        return value_names(where)
    values = (value for node in where for value in node.outputs)
    return {value.name or "" for value in (*where.inputs, *values)}


def _integers(value: ir.Value) -> Array | None:
    """Return the int64 numbers of a constant: axes, sizes and shapes."""
    return array_of(value) if value.dtype == ir.DataType.INT64 else None


def _infer(node: ir.Node, opset: int) -> None:
    """Infer a node's outputs from the types of its operands and integer constants."""
    for value in node.inputs:  # a constant of a file may have neither type nor shape
        known = array_of(value) if value is not None and value.type is None else None
        if value is not None and known is not None:
            value.type = ir.TensorType(ir.DataType.from_numpy(known.dtype))
            value.shape = ir.Shape(known.shape)
    try:
        inferred = infer_node(node, opset, known=_integers)
    except REFUSALS:
        return
    for value, known_of in inferred.items():
        value.type, value.shape = known_of
