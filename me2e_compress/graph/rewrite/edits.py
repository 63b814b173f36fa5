"""Edits of graphs that keep the interface: inputs and outputs."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.base.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import (
    Array,
    bodies_of,
    graphs_of,
    is_read,
    nodes_in,
    producer_of,
)


def value_names(graph: ir.Graph) -> set[str]:
    """Collect the names of all values of a graph and of the bodies inside it."""
    names: set[str] = set()
    for body in graphs_of(graph):
        names.update(value.name or "" for value in body.inputs)
        names.update(body.initializers)
        names.update(value.name or "" for node in body for value in node.outputs)
    return names


def fresh_name(name: str, names: set[str]) -> str:
    """Return ``name``, or ``name_1``, ... if it is taken, and add it to the names."""
    unique, count = name, 0
    while unique in names:
        count += 1
        unique = f"{name}_{count}"
    names.add(unique)
    return unique


def add_constant(
    graph: ir.Graph, array: Array, name: str, names: set[str] | None = None
) -> ir.Value:
    """Register an initializer under this name, or ``name_1``, ... if it is taken.

    ``names`` are the taken ones, to which the new one is added; None collects them from
    the whole graph, which is slow for many constants.
    """
    unique = fresh_name(name, value_names(graph) if names is None else names)
    flat = np.ascontiguousarray(array).reshape(array.shape)
    tensor = ir.tensor(flat, name=unique)
    value = ir.Value(
        name=unique,
        shape=ir.Shape(array.shape),
        type=ir.TensorType(tensor.dtype),
        const_value=tensor,
    )
    graph.register_initializer(value)
    return value


def can_replace(old: ir.Value, new: ir.Value) -> bool:
    """Return whether ``new`` can replace ``old`` without changing the interface."""
    if not old.is_graph_output():
        return True
    port = new.is_graph_output() or new.is_graph_input() or new.is_initializer()
    return not port and new.graph is old.graph


def replace_value(old: ir.Value, new: ir.Value, names: set[str] | None = None) -> None:
    """Replace a value in all its readers; a graph output keeps its name.

    If ``old`` is a graph output, ``new`` becomes that output under its name. ``names``
    are the taken ones, as in :func:`add_constant`.

    Raises:
        GraphError: ``old`` is a graph output, and ``new`` is an input, an initializer,
            another output or of another graph.
    """
    if not old.is_graph_output():
        old.replace_all_uses_with(new)
        return
    graph = old.graph
    if graph is None or not can_replace(old, new):
        raise GraphError(f"output {old.name} cannot be made of {new.name}: add a node")
    name, shape, kind = old.name, old.shape, old.type
    old.replace_all_uses_with(new, replace_graph_outputs=True)
    # The new value takes over name and type of the output
    used = value_names(graph) if names is None else names
    old.name = fresh_name(f"{name}_replaced", used)
    new.name, new.shape, new.type = name, shape, kind


def bypass(old: ir.Value, new: ir.Value) -> bool:
    """Replace a value and return True; False if that would change the interface."""
    if not can_replace(old, new):
        return False
    replace_value(old, new)
    return True


def put(
    old: ir.Node,
    op_type: str,
    inputs: Sequence[ir.Value | None],
    *,
    by: str,
    sources: Sequence[ir.Node] = (),
    attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
    domain: str = "",
) -> ir.Node:
    """Replace a node by one operator, which gets its name and the name of its output.

    ``by`` is the pass's name, ``sources`` are other nodes that the new one replaces;
    the graph must import ``domain``.

    Raises:
        GraphError: another output of the node is read.
    """
    graph, result = old.graph, old.outputs[0]
    if not isinstance(graph, ir.Graph):
        raise GraphError(f"node {old.name} is not in a graph")
    if read := [value.name for value in old.outputs[1:] if is_read(value)]:
        raise GraphError(f"node {old.name} cannot be replaced: {read[0]} is read too")
    # The new node takes the place, the name and the origins of the old
    new = ir.node(
        op_type, inputs, attributes, domain=domain, name=old.name, num_outputs=1
    )
    new.outputs[0].shape, new.outputs[0].type = result.shape, result.type
    new.outputs[0].name = result.name
    provenance.inherit(new, (old, *sources), by=by)
    graph.insert_before(old, new)
    replace_value(result, new.outputs[0])
    remove_node(old)
    return new


def remove_node(node: ir.Node) -> None:
    """Remove a node with its bodies; a GraphError if it is read or in no graph."""
    graph = node.graph
    if not isinstance(graph, ir.Graph):
        raise GraphError(f"node {node.name} is not in a graph")
    if read := [value.name for value in node.outputs if is_read(value)]:
        raise GraphError(f"node {node.name} cannot be removed: {read[0]} is read")
    for body in bodies_of(node):
        _empty(body)
    graph.remove(node, safe=True)


def remove_unread(values: Iterable[ir.Value | None]) -> None:
    """Remove the unread makers of values, and nodes that become unread by that."""
    waiting = [producer_of(value) for value in values]
    while waiting:
        node = waiting.pop()
        if node is None or node.graph is None or any(map(is_read, node.outputs)):
            continue
        waiting.extend(node.predecessors())
        remove_node(node)


def _empty(body: ir.Graph) -> None:
    """Remove all nodes of a body, so that they read no outer values any more."""
    for node in body:
        for inner in bodies_of(node):
            _empty(inner)
    body.outputs.clear()
    body.remove(list(body), safe=True)


def remove_dead(graph: ir.Graph) -> int:
    """Remove unread nodes and initializers; return how many there were."""
    # Initializers that were read only by removed nodes do not count
    idle = sum(len(_idle(inner)) for inner in graphs_of(graph))
    count = 0
    for inner in reversed(list(graphs_of(graph))):
        for node in reversed(inner):
            if not any(is_read(value) for value in node.outputs):
                remove_node(node)
                count += 1
    for inner in graphs_of(graph):
        for value in _idle(inner):
            del inner.initializers[value.name or ""]
    return count + idle


def _idle(graph: ir.Graph) -> list[ir.Value]:
    values = graph.initializers.values()
    return [v for v in values if not is_read(v) and not v.is_graph_input()]


def sweep(model: ir.Model) -> None:
    """Remove unread nodes, weights and functions."""
    # Other nodes do not change, not even by dropping default attributes or empty
    # inputs: a changed node would have to name the pass
    remove_dead(model.graph)
    common.RemoveUnusedFunctionsPass()(model)  # type: ignore[no-untyped-call]


def lift_constants(model: ir.Model) -> int:
    """Turn Constant nodes of a graph and its bodies into initializers; count them."""
    # Graph outputs stay, and constants of functions, which have no initializers
    before = _constants(model)
    if not before:
        return 0
    # onnx-ir encodes the short forms of text as ASCII; a tensor holds any text
    for node in before:
        for name in ("value_string", "value_strings"):
            if name in node.attributes:
                texts = np.array(node.attributes.pop(name).value, dtype=object)
                tensor = ir.StringTensor(
                    [text.encode() for text in texts.flat],
                    shape=ir.Shape(texts.shape),
                    name=node.outputs[0].name,
                )
                node.attributes["value"] = ir.AttrTensor("value", tensor)
    common.LiftConstantsToInitializersPass(lift_all_constants=True, size_limit=0)(model)
    return len(before) - len(_constants(model))


def _constants(model: ir.Model) -> list[ir.Node]:
    nodes = (node for node in nodes_in(model.graph) if node.domain == "")
    constants = (node for node in nodes if node.op_type == "Constant")
    return [node for node in constants if not node.outputs[0].is_graph_output()]
