"""What onnxruntime's optimizer makes of a graph, and which node became which."""

import tempfile
from collections import Counter
from collections.abc import Iterator, Mapping
from pathlib import Path

import onnx_ir as ir

from me2e_compress.graph import producer_of
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session

_JOINTS = "/_"
"""What stands between the name of a node and what onnxruntime adds to it:
``/MatMulAddFusion``, ``_nchwc``, ``_token_1``."""


def optimized(model: ir.Model, provider: Provider = CPU) -> ir.Model:
    """Return a graph as onnxruntime's optimizations leave it, on this machine.

    Its operators are those that run: ``QLinearConv``, ``FusedConv``, ``ReorderInput``.

    Args:
        model: the graph; it stays as it is.
        provider: what runs it.

    Raises:
        GraphError: onnxruntime cannot run this graph.
    """
    with tempfile.TemporaryDirectory(prefix="me2e-optimized-") as folder:
        path = Path(folder) / "model.onnx"
        Session(model, threads=1, rewritten=path, provider=provider)
        found = ir.load(path)
        ir.external_data.load_to_model(found)
    return found


def with_unique_names(model: ir.Model) -> ir.Model:
    """Return a graph whose nodes can be told apart by name: itself, or a copy.

    Nodes without a name, or with one that others have, are called after what they
    answer.
    """
    counts = Counter(node.name for node in model.graph)
    if all(name and count == 1 for name, count in counts.items()):
        return model
    copy = model.clone()
    for node in copy.graph:
        if not node.name or counts[node.name] > 1:
            node.name = f"{node.name or node.op_type}:{node.outputs[0].name}"
    return copy


def origins(source: ir.Model, found: ir.Model) -> dict[str, ir.Node]:
    """Return for the nodes that run the node of the graph that each stands for.

    A fused node stands for the node whose name it carries on, or else for the last one
    that it took in. A node that only changes a layout belongs to its reader, else to
    whom it reads.

    Args:
        source: a graph whose nodes have names of their own.
        found: what :func:`optimized` made of it.

    Returns:
        By name of the node that runs; without those of which nothing is known.
    """
    names = {str(node.name): node for node in source.graph}
    makers = {str(value.name): node for node in source.graph for value in node.outputs}
    known = {node: _told(node, names, makers) for node in found.graph}
    for node in reversed(found.graph):
        known[node] = known[node] or _first(
            known.get(reader) for value in node.outputs for reader in value.consumers()
        )
    for node in found.graph:
        known[node] = known[node] or _first(
            known.get(maker)
            for value in node.inputs
            if (maker := producer_of(value)) is not None
        )
    return {str(node.name): each for node, each in known.items() if each is not None}


def _told(
    node: ir.Node, names: Mapping[str, ir.Node], makers: Mapping[str, ir.Node]
) -> ir.Node | None:
    """Return the node that a name or an output speaks of."""
    name = str(node.name)
    for stem in _stems(name):
        if stem in names:
            return names[stem]
    return _first(makers.get(str(value.name)) for value in node.outputs)


def _stems(name: str) -> Iterator[str]:
    """Walk a name and what is left of it without its last parts, longest first."""
    yield name
    for end in range(len(name) - 1, 0, -1):
        if name[end] in _JOINTS:
            yield name[:end]


def _first(found: Iterator[ir.Node | None]) -> ir.Node | None:
    return next((each for each in found if each is not None), None)
