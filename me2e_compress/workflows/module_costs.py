"""Costs of modules per frame besides MACs: activations and share of the time."""

import dataclasses
from collections import Counter
from collections.abc import Iterable
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import EvaluationError
from me2e_compress.graph import provenance
from me2e_compress.graph.modules import Item
from me2e_compress.graph.summary import activation_bytes
from me2e_compress.runtime.latency_trace import LatencyTrace, shares


def with_activations(items: Iterable[Item], folded: ir.Model) -> tuple[Item, ...]:
    """Return items with the bytes that each module's nodes write in a frame.

    The graph `folded` is imported, with shapes inferred.
    """
    known, unknown = Counter[str](), Counter[str]()
    for node in folded.graph:
        size, module = activation_bytes(node), provenance.module_of(node)
        known[module] += size or 0
        unknown[module] += size is None
    # bytes are None where no node of a module tells them
    return tuple(
        dataclasses.replace(
            item,
            activation_bytes=known[item.module]
            if known[item.module] or not unknown[item.module]
            else None,
            unknown_activation_nodes=unknown[item.module],
        )
        for item in items
    )


def with_latency(items: Iterable[Item], trace: LatencyTrace) -> tuple[Item, ...]:
    """Return items with the share of a frame's time that each module took.

    Time between nodes, or of nodes without a module, counts for no module: the shares
    need not add up to 1.
    """
    found = {each.name: each.share for each in shares(trace.modules_us)}
    return tuple(
        dataclasses.replace(item, latency_share=found.get(item.module))
        for item in items
    )


def trace_of(path: str | Path, model: Path) -> LatencyTrace:
    """Read a trace; it must be by module, and of this very model."""
    trace = LatencyTrace.load(Path(path))
    if trace.model_sha256 != graph.sha256_of(model):
        raise EvaluationError(f"{path}: a trace of another model than {model.name}")
    if not trace.modules_us:
        raise EvaluationError(
            f"{path}: has no times by module: profile {model.name} with --by-module"
        )
    return trace
