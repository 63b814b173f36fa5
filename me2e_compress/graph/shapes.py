"""Shapes: read those that are known, and infer the others."""

import onnx
import onnx_ir as ir

INLINE_BYTES = 1024
"""Weights up to this size are shown to ONNX's inference: shapes and axes are."""


def static_shape(value: ir.Value | None) -> tuple[int, ...] | None:
    """Return a value's shape if every dimension is a known number."""
    if value is None or value.shape is None or not value.shape.is_static():
        return None
    return tuple(int(dim) for dim in value.shape.numpy())


def open_shape(value: ir.Value | None) -> tuple[int | None, ...] | None:
    """Return a value's shape, None for every open dimension; None if unknown."""
    if value is None or value.shape is None:
        return None
    return tuple(dim if isinstance(dim, int) else None for dim in value.shape)


def rank_of(value: ir.Value | None) -> int | None:
    """Return how many dimensions a value has; None if that is not known."""
    return None if value is None or value.shape is None else len(value.shape)


def infer_shapes(model: ir.Model) -> None:
    """Infer types and shapes by ONNX, data propagation included, in place.

    A node of an unknown domain stops nothing: what it gives keeps the shape that the
    file records, or none. A graph that ONNX cannot infer at all stays as it is, and
    so do the interface and the order of the initializers in any case.
    """
    try:
        proto = onnx.shape_inference.infer_shapes(
            _without_weights(model), strict_mode=False, data_prop=True
        )
    except (
        onnx.checker.ValidationError,
        onnx.shape_inference.InferenceError,
        ir.serde.SerdeError,
    ):
        return
    _adopt(model.graph, proto.graph, set(model.graph.outputs))


def _adopt(
    graph: ir.Graph, inferred: onnx.GraphProto, interface: set[ir.Value]
) -> None:
    """Copy what was inferred onto the values of a graph and of the graphs in it.

    Only types and shapes are read: building the whole graph anew from its message
    would take as long as the inference.
    """
    known = {info.name: info for info in (*inferred.value_info, *inferred.output)}
    for node, written in zip(graph, inferred.node, strict=True):
        for value in node.outputs:
            info = known.get(value.name or "")
            if info is None or value in interface:
                continue
            kind = ir.serde.deserialize_type_proto_for_type(info.type)
            shape = ir.serde.deserialize_type_proto_for_shape(info.type)
            value.type = kind if kind is not None else value.type
            value.shape = shape if shape is not None else value.shape
        for body in written.attribute:
            if body.type == onnx.AttributeProto.GRAPH:
                _adopt(node.attributes[body.name].as_graph(), body.g, interface)
            elif body.type == onnx.AttributeProto.GRAPHS:
                bodies = node.attributes[body.name].as_graphs()
                for inner, message in zip(bodies, body.graphs, strict=True):
                    _adopt(inner, message, interface)


def _without_weights(model: ir.Model) -> onnx.ModelProto:
    """Write the model with its large weights as inputs; the model stays as it was."""
    graph = model.graph
    inputs, initializers = list(graph.inputs), list(graph.initializers.values())
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
