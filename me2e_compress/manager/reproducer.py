"""When a pass fails: the smallest piece of the graph on which it still fails."""

import os
import re
from collections.abc import Callable
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph.nodes import reads_of

PIPELINE = "pipeline.txt"
"""The file that names the failing pipeline, and so marks the folder as its own."""

Failing = Callable[[ir.Model], bool]


def shrink(model: ir.Model, fails: Failing) -> ir.Model:
    """Halve a graph as long as one of its parts still fails.

    Parts are stretches of nodes in topological order: the first half, the second
    half, the middle; so at most three trials a halving. ``fails`` may change what it is
    given.
    """
    shrinking = True
    while shrinking and len(model.graph) > 1:
        count = len(model.graph)
        half = (count + 1) // 2
        starts = dict.fromkeys((0, count - half, (count - half) // 2))
        for start in starts:
            part = cut_window(model, start, start + half)
            if part is not None and len(part.graph) < count and fails(part.clone()):
                model = part
                break
        else:
            shrinking = False
    return model


def cut_window(model: ir.Model, start: int, stop: int) -> ir.Model | None:
    """Cut nodes start..stop out of a graph; what they read becomes an input.

    None where a value that crosses the cut has no known type and shape, since the
    part could not say what it takes.
    """
    nodes = [node for i, node in enumerate(model.graph) if start <= i < stop]
    inside = set(nodes)
    made = {id(value) for node in nodes for value in node.outputs}
    inputs = {
        value.name: value
        for node in nodes
        for value in reads_of(node)
        if id(value) not in made and not value.is_initializer()
    }
    outputs = {
        value.name: value
        for node in nodes
        for value in node.outputs
        if value.name
        and (
            value.is_graph_output()
            or not inside.issuperset(value.consumers() or [None])
        )
    }
    crossing = [*inputs.values(), *outputs.values()]
    if not outputs or any(v.type is None or v.shape is None for v in crossing):
        return None
    # Weights, functions and opsets come along
    body = ir.convenience.extract(
        model.graph, list(inputs.values()), list(outputs.values())
    )
    body.opset_imports.update(model.graph.opset_imports)
    functions = [function.clone() for function in model.functions.values()]
    part = ir.Model(body, ir_version=model.ir_version, functions=functions)
    part.metadata_props["me2e.reproducer"] = "part of a graph"
    return part


def write(folder: Path, model: ir.Model, pipeline: str, seed: int, reason: str) -> Path:
    """Write the piece, the pipeline that fails on it and the reason into a folder."""
    name = re.sub(r"[^a-z0-9]+", "-", pipeline.lower()).strip("-")[:60]
    wanted = folder / f"reproducer-{name}"
    target, count = wanted, 1
    # A folder that is not there, or holds the reproducer of this pipeline
    while os.path.lexists(target):
        about = target / PIPELINE
        if about.is_file() and about.read_bytes() == f"{pipeline}\n".encode():
            break
        count += 1
        target = wanted.with_name(f"{wanted.name}-{count}")
    target.mkdir(parents=True, exist_ok=True)
    graph.save(model, target / "model.onnx")
    (target / PIPELINE).write_text(pipeline + "\n", encoding="utf-8")
    (target / "why.txt").write_text(f"{reason}\nseed {seed}\n", encoding="utf-8")
    return target
