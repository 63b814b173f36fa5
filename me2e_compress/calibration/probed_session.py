"""Open a model with probes, in the memory and nearly the time of the model."""

import tempfile
from collections.abc import Iterator, Sequence
from functools import partial
from pathlib import Path

import onnx_ir as ir
import onnx_ir.passes.common as common

from me2e_compress.graph.nodes import makers_of, reads_of
from me2e_compress.runtime.probing import READINGS, Probe, insert_probes
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session


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
