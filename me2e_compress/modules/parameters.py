"""Modules of nodes by the names of the weights that reach them."""

from collections.abc import Collection, Mapping, Sequence

import onnx_ir as ir

from me2e_compress.modules.module_map import ModuleMap
from me2e_compress.modules.paths import parameter_path


def is_constant(nodes: Sequence[ir.Node]) -> frozenset[ir.Node]:
    """Return the nodes that compute from constants alone; nodes come in graph order."""
    found: set[ir.Node] = set()
    for node in nodes:
        if _holds_a_graph(node):
            continue
        if all(_known(value, found) for value in node.inputs if value is not None):
            found.add(node)
    return frozenset(found)


def by_parameter(
    nodes: Sequence[ir.Node],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Return the module of every node that named parameters reach.

    Args:
        nodes: all nodes, in graph order.
        modules: the map.
        by_scope: module of each node by its scope, to recognise merged initializers.
        constant: the nodes that compute from constants alone.
    """
    claims: dict[ir.Value, str | None] = {}
    placed: dict[ir.Node, str] = {}
    for node in nodes:
        votes = [
            module
            for value in node.inputs
            if value is not None
            and (module := _claim(value, claims, modules, by_scope)) is not None
        ]
        votes = _copied(node, modules, constant) or votes
        if votes:
            placed[node] = votes[0]
        if node in constant:
            claims.update((value, placed.get(node)) for value in node.outputs)
    for node in nodes:
        if node not in placed and (bias := _bias_reader(node)) is not None:
            module = placed.get(bias)
            if module is not None:
                placed[node] = module
    return placed


def _copied(
    node: ir.Node, modules: ModuleMap, constant: Collection[ir.Node]
) -> list[str]:
    """Return the module of a parameter that is stored as a copy of an equal one.

    TorchScript's exporter writes parameters of equal numbers once, and the others as
    an Identity of it that has their name.
    """
    if node.op_type != "Identity" or node not in constant:
        return []
    module = modules.match(parameter_path(node.outputs[0].name))
    return [] if module is None else [module]


def _claim(
    value: ir.Value,
    claims: dict[ir.Value, str | None],
    modules: ModuleMap,
    by_scope: Mapping[ir.Node, str],
) -> str | None:
    if value in claims:
        return claims[value]
    module = None
    if value.is_initializer() and not value.is_graph_input():
        module = modules.match(parameter_path(value.name))
        if module is not None and _merged(value, by_scope):
            module = None
        claims[value] = module
    return module


def _merged(value: ir.Value, by_scope: Mapping[ir.Node, str]) -> bool:
    readers = [by_scope[node] for node in value.consumers() if node in by_scope]
    return any(module != readers[0] for module in readers)


def _bias_reader(node: ir.Node) -> ir.Node | None:
    if node.op_type != "MatMul" or node.outputs[0].is_graph_output():
        return None
    readers = node.outputs[0].consumers()
    return readers[0] if len(readers) == 1 and readers[0].op_type == "Add" else None


def _known(value: ir.Value, constant: Collection[ir.Node]) -> bool:
    producer = value.producer()
    if producer is None:
        return value.is_initializer() and not value.is_graph_input()
    return producer in constant


def _holds_a_graph(node: ir.Node) -> bool:
    kinds = (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)
    return any(attribute.type in kinds for attribute in node.attributes.values())
