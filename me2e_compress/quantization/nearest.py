"""For every value the products nearest to it, upstream or downstream."""

from collections.abc import Callable, Collection, Iterable, Mapping
from typing import TypeAlias

import onnx_ir as ir

KEEP = 16
"""How many products are remembered a value: more than the heads of an attention that
is written out head by head; a bound, so that sweeps stay linear."""

Hits: TypeAlias = tuple[tuple[int, ir.Node], ...]
"""(nodes in between, product), nearest first."""

Nearest: TypeAlias = Mapping[ir.Value, Hits]
Test: TypeAlias = Callable[[ir.Node], bool]


def behind(graph: ir.Graph, through: Collection[str], is_product: Test) -> Nearest:
    """List the products that every value comes from, through some operators only.

    Args:
        graph: in topological order.
        through: operators that are looked through.
        is_product: what the search stops at.
    """
    found: dict[ir.Value, Hits] = {}
    for node in graph:
        if is_product(node):
            hits: Hits = ((0, node),)
        elif node.op_type in through:
            hits = _merged(found.get(v, ()) for v in node.inputs if v is not None)
        else:
            continue
        if hits:
            found.update(dict.fromkeys(node.outputs, hits))
    return found


def ahead(graph: ir.Graph, through: Collection[str], is_product: Test) -> Nearest:
    """List the products that read every value, through some operators only."""
    found: dict[ir.Value, Hits] = {}
    beyond: dict[ir.Node, Hits] = {}
    for node in reversed(graph):
        for value in node.outputs:
            found[value] = _merged(
                beyond.get(reader, ()) for reader in value.consumers()
            )
        if is_product(node):
            beyond[node] = ((0, node),)
        elif node.op_type in through:
            beyond[node] = _merged(found[value] for value in node.outputs)
    return found


def _merged(sources: Iterable[Hits]) -> Hits:
    steps: dict[ir.Node, int] = {}
    for hits in sources:
        for step, node in hits:
            steps[node] = min(step + 1, steps.get(node, step + 1))
    nearest = sorted(steps.items(), key=lambda item: item[1])  # stable: graph order
    return tuple((step, node) for node, step in nearest[:KEEP])
