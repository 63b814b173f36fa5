"""An If whose condition is known is one of its branches."""

from collections.abc import Mapping

import onnx_ir as ir

from me2e_compress.graph import array_of, provenance
from me2e_compress.passes.fold_constants.inference import branch_fits
from me2e_compress.rewrite import can_replace, fresh_name, replace_value, value_names


def inline_branch(
    node: ir.Node, opsets: Mapping[str, int], by: str
) -> list[ir.Node] | None:
    """Put the branch that will be taken in an If's place; give its nodes.

    The If stays where its branch hands a value from outside on as a graph output, and
    where a reader would refuse the branch's shape, which the If had kept from it.
    """
    graph = node.graph
    chosen = array_of(node.inputs[0]) if node.inputs else None
    if node.op_type != "If" or chosen is None or not isinstance(graph, ir.Graph):
        return None
    branch = node.attributes[
        "then_branch" if chosen.reshape(-1)[0] else "else_branch"
    ].as_graph()
    results = list(branch.outputs)
    if len(set(results)) < len(results):
        return None
    for old, new in zip(node.outputs, results, strict=True):
        if old.is_graph_output() and new.producer() is None:
            return None
        outside = new.producer() is not None and new.graph is not branch
        if outside and not can_replace(old, new):
            return None
    if not branch_fits(node, branch, opsets):
        return None
    nodes = list(branch)
    _move(branch, node, graph, by)
    for old, new in zip(node.outputs, results, strict=True):
        replace_value(old, new)
    graph.remove(node, safe=True)
    return nodes


def _move(branch: ir.Graph, node: ir.Node, graph: ir.Graph, by: str) -> None:
    names = value_names(graph)
    weights = list(branch.initializers.values())
    nodes = list(branch)
    branch.outputs.clear()
    branch.initializers.clear()
    branch.remove(nodes)
    for value in weights:
        value.name = fresh_name(value.name or "weight", names)
        if value.const_value is not None:
            value.const_value.name = value.name
        graph.register_initializer(value)
    for inner in nodes:
        for value in inner.outputs:
            if value.name:
                value.name = fresh_name(value.name, names)
        provenance.inherit(inner, (inner, node), by=by)
    graph.insert_before(node, nodes)
