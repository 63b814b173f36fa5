"""A fused node that is being rewritten: its operands, and nodes put before it."""

from collections.abc import Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx
import onnx_ir as ir

from me2e_compress.errors import GraphError
from me2e_compress.graph import array_of, provenance
from me2e_compress.graph.nodes import Array
from me2e_compress.rewrite import add_constant, fresh_name, value_names

AttributeValue: TypeAlias = int | float | str | Sequence[int]
Attributes: TypeAlias = Mapping[str, AttributeValue]
Size: TypeAlias = int | ir.Value
"""One dimension: a number, or an int64 value of shape [1] that holds it at run time."""

_INT64 = ir.DataType.INT64


class FusedCall:
    """Where a body or a conversion is written: in front of one node.

    What is added inherits the node's module and origins, and its shape and type are
    inferred at once, so that whoever adds the next node can ask for them.

    Args:
        node: stands in a graph or in a function; it stays as it is.
        opset: of ONNX's own operators.
        by: the name of the pass, for the provenance.
        names: of all values of the model; new ones are entered. None looks at the
            whole graph, which whoever rewrites many nodes had better do once.
        compiled: whether a body may call compiled kernels.
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
        """Insert a node before the fused one; return its first output."""
        name = fresh_name(f"{self._stem}/{op_type}", self.names)
        made = ir.node(
            op_type, inputs, attributes, domain=domain, name=name, num_outputs=outputs
        )
        for index, value in enumerate(made.outputs):
            value.name = fresh_name(f"{name}_{index}", self.names)
        provenance.inherit(made, [self.node], by=self.by)
        self._where.insert_before(self.node, made)
        _infer(made, self.opset)
        return made.outputs[0]

    def constant(self, array: Array, name: str = "constant") -> ir.Value:
        """Add a constant: an initializer, or within a function a Constant node."""
        name = f"{self._stem}/{name}"
        if isinstance(self._where, ir.Graph):
            return add_constant(self._where, array, name, self.names)
        made = ir.node("Constant", [], {"value": ir.tensor(array)}, num_outputs=1)
        made.name = made.outputs[0].name = fresh_name(name, self.names)
        self._where.insert_before(self.node, made)
        _infer(made, self.opset)
        return made.outputs[0]

    def numbers(self, values: float | Sequence[float], like: ir.Value) -> ir.Value:
        """Add a constant of the element type of another value."""
        kind = like.dtype or ir.DataType.FLOAT
        return self.constant(np.asarray(values, kind.numpy()))

    def numbers_of(self, array: Array, like: ir.Value) -> ir.Value:
        """Add an array in the element type of another value."""
        kind = like.dtype or ir.DataType.FLOAT
        return self.constant(array.astype(kind.numpy()))

    def integers(self, values: int | Sequence[int]) -> ir.Value:
        """Add an int64 constant."""
        return self.constant(np.asarray(values, np.int64), "sizes")

    def sizes(self, values: Sequence[Size], shape: Sequence[int] = (-1,)) -> ir.Value:
        """Return sizes as one int64 value: a constant where all are known."""
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
        """Return a value in another element type; itself where it has that."""
        if value.dtype == kind:
            return value
        known = array_of(value)
        if known is not None:
            return self.constant(known.astype(kind.numpy()), "cast")
        return self.add("Cast", [value], {"to": int(kind)})

    def size(self, value: ir.Value, axis: int) -> Size:
        """Return how large a dimension is: a number where the graph knows it."""
        if (known := self.known_size(value, axis)) is not None:
            return known
        shown = self.add("Shape", [value])
        return self.add("Gather", [shown, self.integers([axis])], {"axis": 0})

    def known_size(self, value: ir.Value, axis: int) -> int | None:
        """Return how large a dimension is, if the graph knows it."""
        dim = None if value.shape is None else value.shape[axis]
        return dim if isinstance(dim, int) else None

    def value_of(self, size: Size) -> ir.Value:
        """Return a size as an int64 value of shape [1]."""
        return self.integers([size]) if isinstance(size, int) else size

    def product(self, *sizes: Size) -> Size:
        """Multiply sizes."""
        number, computed = 1, None
        for size in sizes:
            if isinstance(size, int):
                number *= size
            else:
                computed = (
                    size if computed is None else self.add("Mul", [computed, size])
                )
        if computed is None:
            return number
        if number == 1:
            return computed
        return self.add("Mul", [computed, self.integers([number])])

    def reshape(self, value: ir.Value, sizes: Sequence[Size]) -> ir.Value:
        """Reshape to sizes of which some may be known at run time only; -1 is left."""
        given = [size for size in sizes if isinstance(size, int)]
        if len(given) == len(sizes):
            shape = self.integers(given)
        elif len(given) == len(sizes) - 1 and 0 not in given and -1 not in given:
            free = (size if isinstance(size, int) else -1 for size in sizes)
            shape = self.integers(list(free))
        else:
            parts = [self.value_of(size) for size in sizes]
            shape = self.add("Concat", parts, {"axis": 0})
        zero = 0 in given and -1 not in given and self.opset >= _ALLOWZERO_OPSET
        result = self.add("Reshape", [value, shape], {"allowzero": 1} if zero else None)
        if result.shape is None:
            result.shape = _shape(sizes)
        return result

    def transpose(self, value: ir.Value, order: Sequence[int]) -> ir.Value:
        """Put the axes of a value in another order."""
        return self.add("Transpose", [value], {"perm": list(order)})

    def slice(self, value: ir.Value, start: int, end: int, axis: int) -> ir.Value:
        """Take a stretch of one axis."""
        edges = [self.integers([number]) for number in (start, end, axis)]
        return self.add("Slice", [value, *edges])

    def counting(self, size: Size) -> ir.Value:
        """Write 0, 1, ... below a size, int64."""
        if isinstance(size, int):
            return self.integers(list(range(size)))
        end = self.add("Squeeze", [size, self.integers([0])])
        return self.add("Range", [self.integers(0), end, self.integers(1)])

    def concat(self, values: Sequence[ir.Value], axis: int) -> ir.Value:
        """Join values along an axis; one alone stays as it is."""
        if len(values) == 1:
            return values[0]
        return self.add("Concat", values, {"axis": axis})

    def full(self, sizes: Sequence[Size], number: float, like: ir.Value) -> ir.Value:
        """Write one number everywhere, of the element type of another value."""
        kind = like.dtype or ir.DataType.FLOAT
        filling = {"value": ir.tensor(np.full(1, number, kind.numpy()))}
        result = self.add("ConstantOfShape", [self.sizes(sizes)], filling)
        result.shape = _shape(sizes)
        return result

    def split_last(self, value: ir.Value, count: int) -> tuple[ir.Value, ...]:
        """Take the components of the last axis, a handful, each apart."""
        return tuple(
            self.add("Gather", [value, self.integers(index)], {"axis": -1})
            for index in range(count)
        )

    def sum(self, value: ir.Value, axes: Sequence[int]) -> ir.Value:
        """Add up along axes, which go."""
        along = self.integers(list(axes))
        return self.add("ReduceSum", [value, along], {"keepdims": 0})

    def unsqueeze(self, value: ir.Value, axes: Sequence[int]) -> ir.Value:
        """Insert axes of size 1."""
        return self.add("Unsqueeze", [value, self.integers(list(axes))])


_ALLOWZERO_OPSET = 14
"""Before it, a 0 in a shape stands for the dimension of what is reshaped."""


def _shape(sizes: Sequence[Size]) -> ir.Shape:
    dims = (size if isinstance(size, int) and size >= 0 else None for size in sizes)
    return ir.Shape(list(dims))


def names_in(where: ir.Graph | ir.Function) -> set[str]:
    """Collect the names of all values of a graph or function."""
    if isinstance(where, ir.Graph):
        return value_names(where)
    values = (value.name or "" for node in where for value in node.outputs)
    return {*values, *(value.name or "" for value in where.inputs)}


def _typed(value: ir.Value) -> bool:
    """Give a constant type and shape: of a Constant node, files record neither."""
    known = array_of(value)
    if known is None:
        return False
    value.type = ir.TensorType(ir.DataType.from_numpy(known.dtype))
    value.shape = ir.Shape(known.shape)
    return True


def _infer(node: ir.Node, opset: int) -> None:
    """Infer what a node gives, from the types of its operands and small constants."""
    if node.domain or not onnx.defs.has(node.op_type, opset, ""):
        return
    written = ir.to_proto(node)
    types: dict[str, onnx.TypeProto] = {}
    data: dict[str, onnx.TensorProto] = {}
    for value in node.inputs:
        if value is None or not value.name:
            continue
        if value.type is None and not _typed(value):
            return  # what the operands are of decides what the result is of
        info = ir.to_proto(value)
        types[value.name] = info.type
        known = array_of(value) if value.dtype == _INT64 else None
        if known is not None:
            data[value.name] = onnx.numpy_helper.from_array(known)
    schema = onnx.defs.get_schema(node.op_type, opset, "")
    try:
        found = onnx.shape_inference.infer_node_outputs(
            schema,
            written,
            types,
            data,
            opset_imports=[onnx.helper.make_opsetid("", opset)],
        )
    except onnx.shape_inference.InferenceError:
        return
    for value in node.outputs:
        kind = found.get(value.name or "")
        if kind is not None:
            value.type = ir.serde.deserialize_type_proto_for_type(kind)
            value.shape = ir.serde.deserialize_type_proto_for_shape(kind)
