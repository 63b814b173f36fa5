"""What shapes are known, and how to know more."""

import logging

import onnx_ir as ir
import onnx_ir.passes.common as common


def static_shape(value: ir.Value | None) -> tuple[int, ...] | None:
    """Give a value's shape if every dimension is a known number."""
    if value is None or value.shape is None or not value.shape.is_static():
        return None
    return tuple(int(dim) for dim in value.shape.numpy())


def infer_shapes(model: ir.Model) -> None:
    """Let ONNX infer types and shapes, data propagation included, in place.

    A node of an unknown domain stops nothing: what it gives keeps the shape that the
    file records, or none. A graph that ONNX cannot infer at all stays as it is. What
    the interface says, and the order of the initializers, stay in any case.
    """
    before = logging.root.manager.disable
    ports = [(port, port.shape, port.type) for port in _ports(model.graph)]
    order = list(model.graph.initializers.values())
    logging.disable(logging.WARNING)
    try:
        common.ShapeInferencePass(check_type=False, strict_mode=False)(model)
    finally:
        logging.disable(before)
    for port, shape, kind in ports:
        port.shape, port.type = shape, kind
    model.graph.initializers.clear()
    for value in order:
        model.graph.initializers.add(value)


def _ports(graph: ir.Graph) -> tuple[ir.Value, ...]:
    return (*graph.inputs, *graph.outputs)
