"""Constant nodes as initializers."""

import onnx_ir as ir
import onnx_ir.passes.common as common


def lift(model: ir.Model) -> int:
    """Turn Constant nodes of the graph and its subgraphs into initializers.

    Those that are outputs themselves stay, and so do those in function bodies, which
    have no initializers. Counts the nodes that went.
    """
    before = _constants(model)
    for node in before:
        _spell_strings(node)
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(model)
    return len(before) - len(_constants(model))


def _constants(model: ir.Model) -> list[ir.Node]:
    return [
        node
        for node in model.graph.all_nodes()
        if node.op_type == "Constant"
        and node.domain == ""
        and not node.outputs[0].is_graph_output()
    ]


def _spell_strings(node: ir.Node) -> None:
    # onnx_ir encodes the short forms as ASCII; the tensor form holds any text.
    one = node.attributes.get("value_string")
    many = node.attributes.get("value_strings")
    if one is None and many is None:
        return
    texts = [one.as_string()] if one is not None else []
    texts += list(many.as_strings()) if many is not None else []
    tensor = ir.StringTensor(
        [text.encode() for text in texts],
        shape=ir.Shape([] if one is not None else [len(texts)]),
        name=node.outputs[0].name,
    )
    node.attributes.clear()
    node.attributes["value"] = ir.AttrTensor("value", tensor)
