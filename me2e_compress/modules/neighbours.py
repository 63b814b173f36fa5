"""Nodes without a name of their own go with the nodes around them."""

from collections.abc import Collection, Mapping, Sequence

import onnx_ir as ir


def spread(
    nodes: Sequence[ir.Node],
    known: Mapping[ir.Node, str],
    constant: Collection[ir.Node],
) -> dict[ir.Node, str]:
    """Carry what is known to all nodes, in three sweeps over the graph.

    1. Forward: a node takes the word of its producers, of the one that comes last.
    2. Backward: of its consumers, of the one that comes first; so do constants.
    3. What hangs on nothing goes with the node before it (in a subgraph: with the node
       that holds it), at the very start with the one after.

    Args:
        nodes: all nodes, in graph order.
        known: what the nodes say of themselves; must not be empty.
        constant: nodes that compute from constants alone: they are no one's producer.

    Returns:
        The word for every node, those that were known included.
    """
    place = {node: index for index, node in enumerate(nodes)}
    words = dict(known)
    for node in nodes:
        if node in words or node in constant:
            continue
        makers = [value.producer() for value in node.inputs if value is not None]
        heard = [m for m in makers if m in words and m not in constant]
        if heard:
            words[node] = words[max(heard, key=place.__getitem__)]
    for node in reversed(nodes):
        if node in words:
            continue
        readers = {r: None for value in node.outputs for r in value.consumers()}
        heard = [reader for reader in readers if reader in words]
        if heard:
            words[node] = words[min(heard, key=place.__getitem__)]
    last = next(words[node] for node in nodes if node in words)
    for node in nodes:
        last = words.setdefault(node, last)
    return words
