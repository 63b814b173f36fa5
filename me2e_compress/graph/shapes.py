"""What shapes are known, and how to know more."""

from collections.abc import Iterator

import onnx
import onnx_ir as ir

INLINE_BYTES = 1024
"""Weights up to this size are shown to ONNX's inference: shapes and axes are."""


def static_shape(value: ir.Value | None) -> tuple[int, ...] | None:
    """Give a value's shape if every dimension is a known number."""
    if value is None or value.shape is None or not value.shape.is_static():
        return None
    return tuple(int(dim) for dim in value.shape.numpy())


def open_shape(value: ir.Value | None) -> tuple[int | None, ...] | None:
    """Give a value's shape, None for every dimension that is open; None if unknown."""
    if value is None or value.shape is None:
        return None
    return tuple(dim if isinstance(dim, int) else None for dim in value.shape)


def rank_of(value: ir.Value | None) -> int | None:
    """Return how many dimensions a value has; None if that is not known."""
    return None if value is None or value.shape is None else len(value.shape)


def infer_shapes(model: ir.Model) -> None:
    """Let ONNX infer types and shapes, data propagation included, in place.

    A node of an unknown domain stops nothing: what it gives keeps the shape that the
    file records, or none. A graph that ONNX cannot infer at all stays as it is, and
    so do the interface and the order of the initializers in any case.
    """
    try:
        proto = onnx.shape_inference.infer_shapes(
            _without_weights(model), strict_mode=False, data_prop=True
        )
        inferred = ir.from_proto(proto)
    except (
        onnx.checker.ValidationError,
        onnx.shape_inference.InferenceError,
        ir.serde.SerdeError,
    ):
        return
    interface = set(model.graph.outputs)
    for body, answer in zip(model.graphs(), inferred.graphs(), strict=True):
        known = {value.name: value for value in _computed(answer)}
        for value in _computed(body):
            found = known.get(value.name)
            if found is not None and value not in interface:
                value.type = found.type if found.type is not None else value.type
                value.shape = found.shape if found.shape is not None else value.shape


def _computed(graph: ir.Graph) -> Iterator[ir.Value]:
    for node in graph:
        yield from (value for value in node.outputs if value.name)


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
