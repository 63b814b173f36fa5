"""Shape inference of single nodes, with the data that folding has learnt."""

from collections.abc import Mapping

import onnx
import onnx_ir as ir

from me2e_compress.passes.edits import Array, is_standard


def infer_node(
    node: ir.Node, known: Mapping[ir.Value, Array], opsets: Mapping[str, int]
) -> bool:
    """Ask ONNX for the shapes of a node's outputs; True if more is known than before.

    What is recorded already stays: only outputs without a static shape are written.
    """
    version = opsets.get("", opsets.get("ai.onnx", 0))
    if not is_standard(node) or not onnx.defs.has(node.op_type, version):
        return False
    types, data = _inputs(node, known)
    if types is None:
        return False
    schema = onnx.defs.get_schema(node.op_type, version)
    try:
        found = onnx.shape_inference.infer_node_outputs(
            schema,
            ir.serde.serialize_node(node),
            types,
            data,
            opset_imports=[onnx.helper.make_opsetid("", version)],
        )
    except (onnx.shape_inference.InferenceError, onnx.checker.ValidationError):
        return False
    return _record(node, found)


def _inputs(
    node: ir.Node, known: Mapping[ir.Value, Array]
) -> tuple[dict[str, onnx.TypeProto] | None, dict[str, onnx.TensorProto]]:
    types: dict[str, onnx.TypeProto] = {}
    data: dict[str, onnx.TensorProto] = {}
    for value in node.inputs:
        if value is None:
            continue
        if value.type is None or not value.name:
            return None, data
        types[value.name] = ir.serde.serialize_value(value).type
        if value in known:
            data[value.name] = onnx.numpy_helper.from_array(known[value], value.name)
    return types, data


def _record(node: ir.Node, found: Mapping[str, onnx.TypeProto]) -> bool:
    learnt = False
    for value in node.outputs:
        proto = found.get(value.name or "")
        if proto is None or value.is_graph_output():
            continue
        if value.type is None:
            value.type = ir.serde.deserialize_type_proto_for_type(proto)
        shape = ir.serde.deserialize_type_proto_for_shape(proto)
        if shape is None or (value.shape is not None and value.shape.is_static()):
            continue
        if value.shape is None or shape.is_static():
            value.shape = shape
            learnt = True
    return learnt
