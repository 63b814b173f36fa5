"""Shapes of values, layers and products, and their inference."""

import dataclasses
import math
import pkgutil
from collections.abc import Callable, Mapping
from typing import Protocol

import onnx
import onnx_ir as ir

from me2e_compress.graph.nodes import (
    Array,
    array_of,
    input_at,
    is_plugin,
    is_standard,
    nodes_in,
    nodes_of,
)

# Elements that ONNX may propagate in all: about 3 s
MOST_CARRIED = 1 << 24

# Operators through which ONNX propagates elements, without those that read shapes
_CARRY = frozenset(
    {"Add", "Cast", "Concat", "Gather", "Mul", "Slice", "Squeeze", "Sub", "Unsqueeze"}
)
# Operators that make vectors whose length is a constant operand
_FILL = frozenset({"ConstantOfShape", "Expand", "Range", "Tile"})


def can_propagate(graph: ir.Graph) -> bool:
    """Return whether ONNX can propagate the elements of a graph in bounded time."""
    # ONNX may treat every vector as a shape; one of a billion elements takes minutes
    # and all memory. Thirty Concats, each of the one before twice, make it of a scalar
    longest: dict[ir.Value, int] = {}
    total = 0
    for node in nodes_in(graph):
        if node.op_type in _FILL:  # the elements that constants ask for, at most
            arrays = map(array_of, node.inputs)
            counts = [array for array in arrays if array is not None]
            whole = [count for count in counts if count.dtype.kind == "i"]
            size = math.prod(int(n.max(initial=1)) for n in whole if n.size < 64)
        elif node.op_type in _CARRY and node.attributes.get_int("axis", 0) in (0, -1):
            read = [
                longest.get(value, _length(value)) for value in node.inputs if value
            ]
            size = sum(read) if node.op_type == "Concat" else max(read, default=0)
            total += size
        else:
            continue
        made = node.outputs[0]
        if made.shape is None or len(made.shape) < 2:
            longest[made] = max(size, _length(made))
    return total <= MOST_CARRIED


def _length(value: ir.Value) -> int:
    """Return the length of a vector; 1 if it or its shape is unknown."""
    if value.shape is None or not len(value.shape):
        return 1
    size = value.shape[0] if len(value.shape) == 1 else 0
    return size if isinstance(size, int) else 1


class PluginKnowledge(Protocol):
    """Shapes and costs of plugins and fused operators, which ONNX does not know."""

    def infer(self, node: ir.Node) -> bool:
        """Write type and shape of a node's output; return whether anything is new."""
        ...

    def macs(self, node: ir.Node) -> int | None:
        """Count a node's multiply-accumulates; None if they are unknown."""
        ...


def knowledge() -> PluginKnowledge:
    """Return the knowledge of :mod:`me2e_compress.operators`."""
    # This package may not import that one, so it is resolved by name, and only for a
    # graph with plugins
    plugins: PluginKnowledge = pkgutil.resolve_name(
        "me2e_compress.operators.replace:DialectKnowledge"
    )()
    return plugins


# Weights up to this size, as shapes and axes are, are passed to ONNX's inference
INLINE_BYTES = 1024


def static_shape(value: ir.Value | None) -> tuple[int, ...] | None:
    """Return a value's shape if every dimension is a known number."""
    if value is None or value.shape is None or not value.shape.is_static():
        return None
    return tuple(int(dim) for dim in value.shape.numpy())


def is_static(model: ir.Model) -> bool:
    """Return whether the size of every input is known."""
    return all(static_shape(value) is not None for value in model.graph.inputs)


def open_shape(value: ir.Value | None) -> tuple[int | None, ...] | None:
    """Return a value's shape, None for every open dimension; None if unknown."""
    if value is None or value.shape is None:
        return None
    return tuple(dim if isinstance(dim, int) else None for dim in value.shape)


def rank_of(value: ir.Value | None) -> int | None:
    """Return the number of dimensions of a value; None if it is unknown."""
    return None if value is None or value.shape is None else len(value.shape)


def infer_shapes(
    model: ir.Model, *, strict: bool = False, written: onnx.ModelProto | None = None
) -> None:
    """Infer types and shapes with ONNX, in place, with data propagation if possible.

    A graph that ONNX cannot infer at all stays as it is. ``strict`` refuses shapes that
    contradict each other; ``written`` is this graph by :func:`without_weights`, None
    writes it.

    Raises:
        onnx.shape_inference.InferenceError: strict, and shapes contradict each other.
    """
    while _infer_once(model, strict, written):
        # Plugins of known dialects are inferred too; outputs of unknown ones keep the
        # shape that the file records, or none
        bare = [
            node
            for node in nodes_in(model.graph)
            if is_plugin(node) and None in map(static_shape, node.outputs)
        ]
        if not bare or not any([knowledge().infer(node) for node in bare]):
            return
        written = None  # shapes behind a plugin are known now, up to the next plugin


def _infer_once(model: ir.Model, strict: bool, written: onnx.ModelProto | None) -> bool:
    """Infer shapes with ONNX once; return whether it could read the graph."""
    try:
        proto = onnx.shape_inference.infer_shapes(
            without_weights(model) if written is None else written,
            strict_mode=strict,
            data_prop=can_propagate(model.graph),
        )
    except (
        onnx.checker.ValidationError,
        onnx.shape_inference.InferenceError,
        ir.serde.SerdeError,
    ) as error:
        if strict and isinstance(error, onnx.shape_inference.InferenceError):
            raise
        return False
    _adopt(model.graph, proto.graph, set(model.graph.outputs))
    return True


def _adopt(
    graph: ir.Graph, inferred: onnx.GraphProto, interface: set[ir.Value]
) -> None:
    """Copy inferred types and shapes to the values of a graph and its subgraphs."""
    # To deserialize the whole graph would take as long as the inference
    known = {info.name: info for info in (*inferred.value_info, *inferred.output)}
    for node, written in zip(graph, inferred.node, strict=True):
        for value in node.outputs:
            info = known.get(value.name or "")
            if info is None:
                continue
            shape = ir.serde.deserialize_type_proto_for_shape(info.type)
            # Open dimensions of outputs become numbers: behind an exporter's symbol
            # (`Gathery_dim_0`), shape arithmetic could not be folded
            if value in interface:
                value.shape = refined(value.shape, shape)
                continue
            kind = ir.serde.deserialize_type_proto_for_type(info.type)
            value.type = kind if kind is not None else value.type
            value.shape = shape if shape is not None else value.shape
        for body in written.attribute:
            if body.type == onnx.AttributeProto.GRAPH:
                _adopt(node.attributes[body.name].as_graph(), body.g, interface)
            elif body.type == onnx.AttributeProto.GRAPHS:
                bodies = node.attributes[body.name].as_graphs()
                for inner, message in zip(bodies, body.graphs, strict=True):
                    _adopt(inner, message, interface)


def records_shapes(model: ir.Model) -> bool:
    """Return whether a graph says the shape of a value that is no output."""
    outputs = set(model.graph.outputs)
    made = (value for node in model.graph for value in node.outputs)
    return any(value.shape is not None for value in made if value not in outputs)


def without_inferable_shapes(model: ir.Model) -> ir.Model:
    """Return a copy that records no types and shapes which inference gives again."""
    copy = model.clone()
    # Those of plugins stay; those of initializers stand in the initializers
    nodes = [node for node in copy.graph if not is_plugin(node)]
    inner = {value for node in nodes for value in node.outputs}
    known = {value: (value.type, value.shape) for value in inner}
    for value in inner.difference(copy.graph.outputs):
        value.type = value.shape = None
    infer_shapes(copy)
    for value in inner.difference(copy.graph.outputs):
        same = (value.type, value.shape) == known[value]
        value.type, value.shape = (None, None) if same else known[value]
    for value in copy.graph.initializers.values():
        value.type = value.shape = None
    return copy


def unshaped_plugins(model: ir.Model) -> list[ir.Node]:
    """List the plugins with an output of unknown shape, which nothing can infer."""
    return [
        node
        for node in nodes_of(model)
        if is_plugin(node)
        and node.op_identifier() not in model.functions
        and any(value.shape is None for value in node.outputs if value.name)
    ]


def refined(declared: ir.Shape | None, inferred: ir.Shape | None) -> ir.Shape | None:
    """Return a declared shape, or the inferred one, with open dimensions filled in."""
    if declared is None:
        return inferred
    if inferred is None or len(declared) != len(inferred):
        return declared
    pairs = list(zip(declared, inferred, strict=True))
    if not any(isinstance(new, int) and not isinstance(old, int) for old, new in pairs):
        return declared
    return ir.Shape([new if isinstance(new, int) else old for old, new in pairs])


def without_weights(model: ir.Model) -> onnx.ModelProto:
    """Write the model with its large weights as inputs; the model stays as it was."""
    graph = model.graph
    inputs, initializers = list(graph.inputs), list(graph.initializers.values())
    # Weights become inputs while the graph is written, and weights again at the end
    try:
        for value in initializers:
            tensor = value.const_value
            if tensor is not None and tensor.nbytes > INLINE_BYTES:
                del graph.initializers[value.name or ""]
                if value not in inputs:
                    graph.inputs.append(value)
        return ir.to_proto(model)
    finally:
        graph.inputs.clear()
        graph.inputs.extend(inputs)
        graph.initializers.clear()
        for value in initializers:
            graph.initializers.add(value)


# The exceptions of `infer_node` where a node does not accept its inputs
REFUSALS = (onnx.shape_inference.InferenceError, onnx.checker.ValidationError)

NOTHING: Mapping[ir.Value, ir.Value] = {}


def small_array(value: ir.Value) -> Array | None:
    """Return a constant that is small enough to be an axis, a size or a shape."""
    tensor = value.const_value
    if tensor is not None and tensor.nbytes > INLINE_BYTES:
        return None
    return array_of(value)


def infer_node(
    node: ir.Node,
    opset: int,
    *,
    known: Callable[[ir.Value], Array | None] = small_array,
    instead: Mapping[ir.Value, ir.Value] = NOTHING,
) -> dict[ir.Value, tuple[ir.TypeProtocol | None, ir.Shape | None]]:
    """Infer types and shapes of the outputs of one standard node.

    The result is empty if an input has no type, or ONNX has no such operator. ``known``
    returns the array of an input, or None; ``instead`` maps inputs to values that are
    read in their place. A node that does not accept its inputs raises `REFUSALS`.
    """
    if not is_standard(node) or not onnx.defs.has(node.op_type, opset):
        return {}
    # The types of its inputs, and the numbers of small constants
    types: dict[str, onnx.TypeProto] = {}
    data: dict[str, onnx.TensorProto] = {}
    for value in filter(None, node.inputs):
        source = instead.get(value, value)
        if source.type is None or not value.name:
            return {}
        types[value.name] = ir.serde.serialize_value(source).type
        array = known(value)
        if array is not None and array.dtype.kind != "S":  # no shape depends on text
            data[value.name] = onnx.numpy_helper.from_array(array, value.name)
    inferred = onnx.shape_inference.infer_node_outputs(
        onnx.defs.get_schema(node.op_type, opset),
        ir.serde.serialize_node(node),
        types,
        data,
        opset_imports=[onnx.helper.make_opsetid("", opset)],
    )
    kind_of = ir.serde.deserialize_type_proto_for_type
    shape_of = ir.serde.deserialize_type_proto_for_shape
    return {
        value: (kind_of(inferred[value.name]), shape_of(inferred[value.name]))
        for value in node.outputs
        if value.name in inferred
    }


CONVOLUTIONS = ("Conv", "ConvTranspose")
PRODUCTS = ("Gemm", "MatMul")
# Operators of weighted layers: those that have an int8 kernel worth feeding.
WEIGHTED = (*CONVOLUTIONS, *PRODUCTS)

Dims = tuple[int | None, ...]


def bias_of(node: ir.Node) -> ir.Value | None:
    """Return the bias of a Conv, ConvTranspose or Gemm; None if it has none."""
    return input_at(node, 2)


def channel_axis(node: ir.Node) -> int:
    """Return the axis of a layer's weight along which its output channels run.

    Conv [M, C/g, ...]: 0. ConvTranspose [C, M/g, ...]: 1. MatMul [..., K, N]: the last.
    Gemm [K, N]: 1, or 0 where it is transposed.
    """
    if node.op_type in CONVOLUTIONS:
        return CONVOLUTIONS.index(node.op_type)
    if node.op_type == "Gemm":
        return 0 if node.attributes.get_int("transB", 0) else 1
    return (rank_of(node.inputs[1]) or 2) - 1


@dataclasses.dataclass(frozen=True)
class Extent:
    """Size of one matrix product, [M, K] x [K, N].

    Attributes:
        rows: M: of a product with a plain weight, all leading dimensions together;
            of a batch of products, the rows of one. None where that is open.
        columns: N, likewise of one product.
        depth: K, what is summed over.
    """

    rows: int | None
    columns: int | None
    depth: int | None

    @property
    def is_vector(self) -> bool:
        """Whether it degenerates to a matrix-vector product."""
        return 1 in (self.rows, self.columns)


def extent(node: ir.Node, *, weight: bool) -> Extent:
    """Measure a MatMul or Gemm; ``weight`` tells whether the right side is constant."""
    left, right = open_shape(node.inputs[0]), open_shape(node.inputs[1])
    if node.op_type == "Gemm":
        depth, columns = (None, None) if right is None else right[:2]
        if node.attributes.get_int("transB", 0):
            depth, columns = columns, depth
        axis = 1 if node.attributes.get_int("transA", 0) else 0
        return Extent(None if left is None else left[axis], columns, depth)
    # A vector on the right is one column
    columns, depth = None, None
    if right is not None:
        wide = len(right) > 1
        columns, depth = (right[-1], right[-2]) if wide else (1, product(right))
    # Where the right operand differs from batch to batch, the rows of one batch count
    if not left:
        return Extent(None, columns, depth)
    # A weight of shape [K, N] (or [1, ..., K, N]) is shared by every row, whatever the
    # rank of the left operand: [1, 1, 256] x [256, 12] has one row
    shared = weight and right is not None and product(right[:-2]) == 1
    rows = product(left[:-1]) if shared or len(left) == 1 else left[-2]
    return Extent(rows, columns, depth if left[-1] is None else left[-1])


def is_one_matrix(product: ir.Node) -> bool:
    """Return whether a MatMul multiplies every row by the same matrix."""
    left, right = product.inputs[0], static_shape(product.inputs[1])
    if right is None or len(right) < 2:
        return False
    # [K, N], or [1, ..., K, N] of at most the left operand's rank
    rank = rank_of(left) or 0
    return len(right) == 2 or (math.prod(right[:-2]) == 1 and len(right) <= rank)


def product(dims: Dims) -> int | None:
    """Multiply dimensions; None if one of them is open."""
    known = [dim for dim in dims if dim is not None]
    return math.prod(known) if len(known) == len(dims) else None
