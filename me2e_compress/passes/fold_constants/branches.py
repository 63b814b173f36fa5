"""Replace an If whose condition is known by the branch that it takes."""

import onnx_ir as ir

from me2e_compress.graph import array_of, provenance
from me2e_compress.graph.nodes import graphs_of
from me2e_compress.graph.rewrite import (
    can_replace,
    fresh_name,
    remove_node,
    replace_value,
    value_names,
)
from me2e_compress.passes.fold_constants.knowledge import branch_fits


def inline_branches(graph: ir.Graph, opset: int, by: str) -> list[ir.Node] | None:
    """Replace every If of known condition, in bodies too; None where there is none.

    Returns:
        The nodes of the branches, whose shapes the Ifs had hidden.
    """
    known = [
        nodes
        for body in list(graphs_of(graph))
        for node in list(body)
        if node.op_type == "If" and node.graph is body
        if (nodes := inline_branch(node, opset, by)) is not None
    ]
    return [node for nodes in known for node in nodes] if known else None


def inline_branch(node: ir.Node, opset: int, by: str) -> list[ir.Node] | None:
    """Replace an If whose condition is known by the nodes of its branch.

    It stays (None) where its branch passes an outer value on as a graph output, or
    where a reader would refuse the branch's shape, which the If had hidden from it.
    """
    graph = node.graph
    chosen = array_of(node.inputs[0]) if node.inputs else None
    if node.op_type != "If" or chosen is None or not isinstance(graph, ir.Graph):
        return None
    # Choose the branch and check that it can take the place
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
    if not branch_fits(node, branch, opset):
        return None
    # Move the nodes out and rewire their readers
    nodes = list(branch)
    _move(branch, node, graph, by)
    for old, new in zip(node.outputs, results, strict=True):
        replace_value(old, new)
    remove_node(node)
    return nodes


def _move(branch: ir.Graph, node: ir.Node, graph: ir.Graph, by: str) -> None:
    names = value_names(graph)
    weights = list(branch.initializers.values())
    nodes = list(branch)
    # Detach everything before it enters the outer graph
    branch.outputs.clear()
    branch.initializers.clear()
    branch.remove(nodes)
    # Names must be unique in the whole model
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
