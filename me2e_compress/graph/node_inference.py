"""Types and shapes of what one node gives, by ONNX's own inference."""

from collections.abc import Callable, Mapping

import onnx
import onnx_ir as ir

from me2e_compress.graph.nodes import Array, array_of, is_standard
from me2e_compress.graph.shapes import INLINE_BYTES

REFUSALS = (onnx.shape_inference.InferenceError, onnx.checker.ValidationError)
"""What :func:`infer_node` raises where a node does not take what it reads."""

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
) -> Mapping[str, onnx.TypeProto]:
    """Infer what a node of ONNX's own gives; return the types of outputs by name.

    That is nothing where an input has no type, or ONNX has no such operator. ``known``
    tells what an input holds; ``instead`` are values to be read in the place of inputs.

    Raises:
        InferenceError: the node does not take what it reads.
        ValidationError: likewise.
    """
    if not is_standard(node) or not onnx.defs.has(node.op_type, opset):
        return {}
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
    return onnx.shape_inference.infer_node_outputs(
        onnx.defs.get_schema(node.op_type, opset),
        ir.serde.serialize_node(node),
        types,
        data,
        opset_imports=[onnx.helper.make_opsetid("", opset)],
    )
