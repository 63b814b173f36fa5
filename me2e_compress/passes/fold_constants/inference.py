"""Shape inference of single nodes, given the data that folding has found."""

from collections.abc import Mapping

import onnx
import onnx_ir as ir

from me2e_compress.graph import array_of, node_inference
from me2e_compress.graph.nodes import unrenamed
from me2e_compress.graph.rewrite import Array
from me2e_compress.graph.shapes import refined


def learn_shapes(
    node: ir.Node,
    known: Mapping[ir.Value, Array],
    opset: int,
    *,
    trust_shapes: bool = True,
) -> bool:
    """Infer missing shapes of a node's outputs; return whether any is new.

    Use ``trust_shapes=False`` in loops, whose outputs may change shape between rounds.
    """
    try:
        found = node_inference.infer_node(node, opset, known=known.get)
    except node_inference.REFUSALS:
        return False
    return _record(node, found, answers=trust_shapes)


def branch_fits(node: ir.Node, branch: ir.Graph, opset: int) -> bool:
    """Return whether an If's readers would be valid if they read a branch directly.

    An If hides the shapes of its branches: a reader may work only because of that (a
    Range up to a vector of one element).
    """
    instead = dict(zip(node.outputs, branch.outputs, strict=True))
    readers = dict.fromkeys(use.node for value in instead for use in value.uses())
    return all(_accepts(reader, instead, opset) for reader in readers)


def _accepts(node: ir.Node, instead: Mapping[ir.Value, ir.Value], opset: int) -> bool:
    arrays = {
        value: array
        for value in node.inputs
        if value is not None
        and (array := array_of(unrenamed(instead.get(value, value)))) is not None
    }
    try:
        node_inference.infer_node(node, opset, known=arrays.get, instead=instead)
    except node_inference.REFUSALS:
        return False
    return True


def _record(
    node: ir.Node, found: Mapping[str, onnx.TypeProto], *, answers: bool
) -> bool:
    learnt = False
    for value in node.outputs:
        proto = found.get(value.name or "")
        if proto is None:
            continue
        # Shapes of graph outputs are only refined
        if value.is_graph_output():
            shape = ir.serde.deserialize_type_proto_for_shape(proto)
            if answers and (more := refined(value.shape, shape)) is not value.shape:
                value.shape, learnt = more, True
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
