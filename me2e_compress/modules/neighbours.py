"""Nodes without a name of their own go with the nodes around them."""

from collections.abc import Collection, Mapping, Sequence

import onnx_ir as ir


def spread(
    nodes: Sequence[ir.Node],
    known: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Carry what is known to all nodes, in a few sweeps over the graph.

    1. A node whose results all end up in one module, whatever glue they pass on the
       way, prepares that module's input and is of it.
    2. A node whose results go to several modules, or out of the graph, is of the
       module it gets its data from: of its producers, the one that comes last.
    3. What reads no data, as constants do, goes with the consumer that comes first.
    4. What hangs on nothing goes with the node before it (in a subgraph: with the node
       that holds it), at the very start with the one after.

    Args:
        nodes: all nodes, in graph order.
        known: what the nodes say of themselves; must not be empty.
        constant: nodes that compute from constants alone: they are no one's producer.

    Returns:
        The word for every node, those that were known included.
    """
    place = {node: index for index, node in enumerate(nodes)}
    words = dict(known) | _single_destinations(nodes, known)
    for node in nodes:
        if node in words or node in constant:
            continue
        makers = [value.producer() for value in node.inputs if value is not None]
        heard = [m for m in makers if m in words and m not in constant]
        if heard:
            words[node] = words[max(heard, key=place.__getitem__)]
    for node in reversed(nodes):
        heard = [reader for reader in _readers(node) if reader in words]
        if node not in words and heard:
            words[node] = words[min(heard, key=place.__getitem__)]
    last = next(words[node] for node in nodes if node in words)
    for node in nodes:
        last = words.setdefault(node, last)
    return words


def _single_destinations(
    nodes: Sequence[ir.Node], known: Mapping[ir.Node, str]
) -> dict[ir.Node, str]:
    """Find the unknown nodes whose results all end up with one word."""
    ends: dict[ir.Node, str | None] = {}
    for node in reversed(nodes):
        if node in known:
            continue
        heard = {known.get(r) or ends.get(r): None for r in _readers(node)}
        outside = any(value.is_graph_output() for value in node.outputs)
        ends[node] = next(iter(heard)) if len(heard) == 1 and not outside else None
    return {node: word for node, word in ends.items() if word is not None}


def _readers(node: ir.Node) -> list[ir.Node]:
    return [reader for value in node.outputs for reader in value.consumers()]
