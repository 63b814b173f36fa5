"""Probes: nodes added to a graph that measure its tensors as they are computed.

A probe stands right behind the node that makes its tensor, so that the tensor is freed
as early as without it; all readings come out as one more output.
"""

import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.errors import GraphError
from me2e_compress.graph import rewrite
from me2e_compress.graph.nodes import makers_of, reads_of
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session

READINGS = "me2e_readings"
"""Name of the output that the probes write: float32 [tensors x width of the probe]."""

Reading: TypeAlias = tuple[list[ir.Node], list[ir.Value]]
"""Nodes that measure a tensor, in order, and the 1-D values that they produce."""


class Probe(Protocol):
    """Measures tensors by nodes inserted after them."""

    @property
    def width(self) -> int:
        """Number of values read per tensor."""
        ...

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Return the nodes that measure a float32 value, the ``at``-th watched one."""
        ...


def insert_probes(model: ir.Model, tensors: Sequence[str], probe: Probe) -> ir.Model:
    """Return a copy of a graph with a probe right after each tensor's producer.

    The last output of the copy is :data:`READINGS`.
    """
    copy = model.clone()
    made = (value for node in copy.graph for value in node.outputs)
    known = {str(value.name): value for value in (*copy.graph.inputs, *made)}
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    # Measure each tensor right after its producer.
    readings = [
        reading
        for at, name in enumerate(tensors)
        for reading in _watch(copy.graph, known[name], probe, at)
    ]
    # Join all readings into one output.
    joined = ir.node("Concat", readings, {"axis": 0}, name=READINGS)
    joined.outputs[0].name = READINGS
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(tensors) * probe.width])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def _watch(
    where: ir.Graph, value: ir.Value, probe: Probe, at: int
) -> Sequence[ir.Value]:
    nodes: list[ir.Node] = []
    seen = value
    if value.dtype not in (None, ir.DataType.FLOAT):
        nodes.append(ir.node("Cast", [value], {"to": ir.DataType.FLOAT.value}))
        seen = nodes[0].outputs[0]
        seen.shape, seen.dtype = value.shape, ir.DataType.FLOAT
    # Names tell which tensor a probe measures.
    measuring, readings = probe.read(where, seen, at)
    nodes += measuring
    for order, node in enumerate(nodes):
        node.name = f"{READINGS}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    # A graph input is measured before anything else runs.
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    return readings


def shared_constant(
    where: ir.Graph, array: npt.NDArray[np.generic], name: str
) -> ir.Value:
    """Return a constant of the probes, created at its first use."""
    name = f"me2e_probe_{name}"
    known = where.initializers.get(name)
    if known is not None:
        return known
    return rewrite.add_constant(where, array, name, names=set())


def probed_session(
    model: ir.Model,
    tensors: Sequence[str],
    probe: Probe,
    *,
    threads: int,
    optimize: bool,
    provider: Provider = CPU,
) -> Session:
    """Open a model with probes, in the memory and nearly the time of the model.

    onnxruntime optimizes the graph with its probes; then the nodes are put into an
    order in which every watched tensor is freed as early as without them. A provider
    that compiles parts of the graph uses an order of its own.
    """
    probed = insert_probes(model, tensors, probe)
    run = partial(Session, threads=threads, frugal=True, provider=provider)
    if not optimize or provider.native != CPU.native:
        return run(probed, optimize=optimize)
    # Write the optimized graph, reorder it, and run it as it is.
    with tempfile.TemporaryDirectory(prefix="me2e-probed-") as folder:
        path = Path(folder) / "optimized.onnx"
        Session(probed, threads=1, rewritten=path, provider=provider)
        rewritten = ir.load(path)
        common.NameFixPass()(rewritten)  # its fusions give one name to two values
        schedule_probes(rewritten)
        scheduled = path.with_name("scheduled.onnx")
        ir.save(rewritten, scheduled)
        return run(scheduled, optimize=False)


def schedule_probes(model: ir.Model) -> None:
    """Move the nodes of every probe to the earliest position, in place.

    onnxruntime runs nodes in the order of the file (``Session(frugal=True)``). Its
    optimizations append new nodes at the end: the conversion from a blocked layout that
    a probe reads would come last, and keep the tensors of a whole backbone in memory.
    """
    # What the model's own outputs need keeps its order; the rest waits for its inputs.
    nodes = list(model.graph)
    own = makers_of([v for v in model.graph.outputs if v.name != READINGS])
    waiting = {
        node: {
            v for v in reads_of(node) if v.producer() is not None or v.is_graph_input()
        }
        for node in nodes
        if node not in own
    }
    order: list[ir.Node] = []

    def ready(value: ir.Value) -> Iterator[ir.Node]:
        for node in dict.fromkeys(value.consumers()):
            if node in waiting and value in waiting[node]:
                waiting[node].discard(value)
                if not waiting[node]:
                    yield node

    def place(first: Sequence[ir.Node]) -> None:
        pending = list(reversed(first))
        while pending:
            node = pending.pop()
            order.append(node)
            pending += [each for out in node.outputs for each in ready(out)]

    # Place nodes without inputs, readers of inputs, then the rest.
    place([node for node in waiting if not waiting[node]])
    for value in model.graph.inputs:
        place(list(ready(value)))
    for node in nodes:
        if node in own:
            place([node])
    placed = set(order)
    order += [node for node in nodes if node not in placed]
    model.graph.remove(nodes)
    model.graph.extend(order)
