"""Read back the graph that onnxruntime's optimizer makes, and map its nodes."""

import tempfile
from collections import Counter
from collections.abc import Iterable
from itertools import chain
from pathlib import Path

import onnx_ir as ir

from me2e_compress.graph import producer_of
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session

# Separators between a node's name and the suffix that onnxruntime adds:
# `/MatMulAddFusion`, `_nchwc`, `_token_1`.
_SEPARATORS = "/_"


def optimize(model: ir.Model, provider: Provider = CPU) -> ir.Model:
    """Return a graph as onnxruntime's optimizations leave it on this machine."""
    # Its operators are those that run: `QLinearConv`, `FusedConv`, `ReorderInput`
    with tempfile.TemporaryDirectory(prefix="me2e-optimized-") as folder:
        path = Path(folder) / "model.onnx"
        Session(model, threads=1, int8_kernels=True, rewritten=path, provider=provider)
        compiled = ir.load(path)
        ir.external_data.load_to_model(compiled)
    return compiled


def with_unique_names(model: ir.Model) -> ir.Model:
    """Return a graph whose nodes have unique names: the graph itself, or a copy."""
    counts = Counter(node.name for node in model.graph)
    if all(name and count == 1 for name, count in counts.items()):
        return model
    copy = model.clone()
    # Nodes without a name, or with a shared one, are named after their first output
    for node in copy.graph:
        if not node.name or counts[node.name] > 1:
            node.name = f"{node.name or node.op_type}:{node.outputs[0].name}"
    return copy


def origins(source: ir.Model, compiled: ir.Model) -> dict[str, ir.Node]:
    """Return the source node for each node that runs, by the running node's name.

    Nodes without a known origin are missing. ``compiled`` is what :func:`optimize` made
    of ``source``, whose nodes have unique names.
    """
    names = {str(node.name): node for node in source.graph}
    makers = {str(value.name): node for node in source.graph for value in node.outputs}
    known: dict[ir.Node, ir.Node | None] = {}
    for node in compiled.graph:
        # A fused node belongs to the node whose name it keeps (or its prefix at a
        # separator, the longest first), or else to the last one that it absorbed
        name = str(node.name)
        ends = (at for at in range(len(name) - 1, 0, -1) if name[at] in _SEPARATORS)
        stems = (name, *(name[:end] for end in ends))
        named = (names.get(stem) for stem in stems)
        made = (makers.get(str(value.name)) for value in node.outputs)
        known[node] = _first_known(chain(named, made))
    # A node that only changes a layout belongs to its reader's node
    for node in reversed(compiled.graph):
        known[node] = known[node] or _first_known(
            known.get(reader) for value in node.outputs for reader in value.consumers()
        )
    # Readers may be unknown too: fall back to the inputs
    for node in compiled.graph:
        known[node] = known[node] or _first_known(
            known.get(maker)
            for value in node.inputs
            if (maker := producer_of(value)) is not None
        )
    return {str(node.name): made for node, made in known.items() if made is not None}


def _first_known(nodes: Iterable[ir.Node | None]) -> ir.Node | None:
    return next((node for node in nodes if node is not None), None)
