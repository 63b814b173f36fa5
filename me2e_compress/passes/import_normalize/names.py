"""Names for nodes that have none of their own."""

import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.passes.import_normalize.bodies import bodies


def name_nodes(model: ir.Model, by: str) -> int:
    """Name every node of the graph, its subgraphs and its functions; count the new.

    A node keeps its name unless an earlier one bears it. New names are the operator's
    (or the taken name) with the first number that is free, so they depend on the
    order of the nodes alone. A node with a past takes the pass's name into it.
    """
    count = 0
    for body in bodies(model):
        nodes = list(body.all_nodes())
        reserved = {node.name for node in nodes if node.name}
        taken: set[str] = set()
        counters: dict[str, int] = {}
        for node in nodes:
            if node.name and node.name not in taken:
                taken.add(node.name)
                continue
            stem = node.name or node.op_type
            number = counters.get(stem, 0)
            while f"{stem}_{number}" in reserved:
                number += 1
            counters[stem] = number + 1
            node.name = f"{stem}_{number}"
            reserved.add(node.name)
            taken.add(node.name)
            provenance.inherit(node, [node], by=by)
            count += 1
    return count
