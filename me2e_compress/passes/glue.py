"""Nodes that only lay out anew what another module made."""

import dataclasses
from collections.abc import Callable

import onnx_ir as ir

from me2e_compress.graph import provenance

LAYOUT = frozenset(
    {"Cast", "Flatten", "Identity", "Reshape", "Squeeze", "Transpose", "Unsqueeze"}
)


def hand_over(model: ir.Model, goes: Callable[[ir.Node], bool]) -> int:
    """Give glue of modules that go to the modules that read it.

    An exporter that finds the same cast of the same value in two modules writes it
    once, with the scope of the first. It computes nothing of that module's own: if the
    first goes, the second must not lose its input.

    Args:
        model: the graph, sorted; modules of nodes change in place.
        goes: whether a node belongs to a module that goes.

    Returns:
        How many nodes changed their module.
    """
    carriers = dict[ir.Node, None]()
    for node in model.graph:
        makers = [value.producer() for value in node.inputs if value is not None]
        outside = all(
            maker is None or maker in carriers or not goes(maker) for maker in makers
        )
        if node.op_type in LAYOUT and goes(node) and outside:
            carriers[node] = None
    count = 0
    for node in reversed(carriers):
        readers = [reader for reader in node.outputs[0].consumers() if not goes(reader)]
        past = provenance.read(node)
        if readers and past is not None:
            module = provenance.module_of(readers[0])
            provenance.stamp(node, dataclasses.replace(past, module=module))
            count += 1
    return count
