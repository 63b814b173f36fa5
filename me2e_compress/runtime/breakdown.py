"""Divide the time of an inference by module and by operator."""

import dataclasses
import json
import tempfile
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from itertools import chain, islice, repeat
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import ProviderError
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.latency_trace import Microseconds
from me2e_compress.runtime.optimized import optimize, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

MOST_EVENTS = 200_000
"""Most nodes times inferences to record: onnxruntime stores half a kilobyte for each
until the end, and drops those beyond a million."""
# Time of an inference outside of its nodes, including the profiler's own work
OUTSIDE = "(between nodes)"
NO_MODULE = "(no module)"
_KERNEL = "_kernel_time"


@dataclasses.dataclass(frozen=True)
class Breakdown:
    """The time of every inference, divided in two ways that each add up to the total.

    Nodes without a module are under :data:`NO_MODULE`, time outside of nodes is under
    :data:`OUTSIDE`; operators are those that run: ``FusedConv``.
    """

    modules_us: Microseconds
    operators_us: Microseconds


@dataclasses.dataclass(frozen=True)
class NodeRun:
    """One node in one inference.

    ``begin_us`` is on the profiler's clock; ``duration_us`` includes its bodies' nodes.
    """

    name: str
    operator: str
    begin_us: int
    duration_us: int


def break_down(
    model: ir.Model,
    module_of: Callable[[ir.Node], str],
    frames: Frames,
    *,
    runs: int,
    warm_up: int,
    threads: int,
    provider: Provider = CPU,
    on_run: Callable[[int, int], None] = lambda done, total: None,
) -> Breakdown:
    """Run a model under onnxruntime's profiler, its recurrent state fed forward.

    ``frames`` repeat as often as needed; ``runs`` inferences count after ``warm_up``
    ones, fewer where that exceeds :data:`MOST_EVENTS`. A provider that runs nodes
    elsewhere than on the CPU is a ProviderError.
    """
    if provider.native != CPU.native:
        raise ProviderError(
            f"provider {provider.name}: times of nodes are measured on the CPU alone"
        )
    # Map the optimized nodes back to the modules of the nodes that they replace.
    source = with_unique_names(model)
    modules = {
        str(copy.name): module_of(node)
        for node, copy in zip(model.graph, source.graph, strict=True)
    }
    compiled = optimize(source, provider)
    sources = origins(source, compiled)
    module_names = {name: modules[str(node.name)] for name, node in sources.items()}
    # Record no more events than the profiler can hold.
    wanted = max(1, min(runs, MOST_EVENTS // max(1, len(compiled.graph))))
    # Profile the source graph: the session optimizes it again.
    with tempfile.TemporaryDirectory(prefix="me2e-profile-") as folder:
        session = Session(
            source, threads=threads, int8_kernels=True, provider=provider,
            profiled=Path(folder),
        )  # fmt: skip
        replayed = replay(session, chain.from_iterable(repeat(frames)))
        for done, _ in enumerate(islice(replayed, warm_up + wanted), 1):
            on_run(max(0, done - warm_up), wanted)
        with session.end_profile().open(encoding="utf-8") as lines:
            measured = list(islice(node_runs(lines), warm_up, None))
    return _sum_times(measured, module_names)


def node_runs(lines: Iterable[str]) -> Iterator[tuple[int, list[NodeRun]]]:
    """Yield the microseconds and nodes of each inference, from a profile's lines."""
    nodes: list[NodeRun] = []
    for line in lines:
        text = line.strip().rstrip(",")
        event: dict[str, Any] = json.loads(text) if text.startswith("{") else {}
        if event.get("cat") == "Node" and str(event["name"]).endswith(_KERNEL):
            # Events come at the end of a node: those of the body of an If, Loop or Scan
            # are earlier, and left out, since the node includes their time
            begin = int(event["ts"])
            while nodes and nodes[-1].begin_us >= begin:
                nodes.pop()
            name = str(event["name"]).removesuffix(_KERNEL)
            operator = str(event["args"]["op_name"])
            nodes.append(NodeRun(name, operator, begin, int(event["dur"])))
        elif event.get("name") == "model_run":
            yield int(event["dur"]), nodes
            nodes = []


def _sum_times(
    runs: Sequence[tuple[int, Sequence[NodeRun]]], module_names: Mapping[str, str]
) -> Breakdown:
    """Add up times, by module and by operator; largest first, outside of nodes last."""
    modules, operators = (
        defaultdict[str, Any](lambda: np.zeros(len(runs), np.int64)) for _ in range(2)
    )
    for index, (taken_us, nodes) in enumerate(runs):
        for node in nodes:
            modules[module_names.get(node.name) or NO_MODULE][index] += node.duration_us
            operators[node.operator][index] += node.duration_us
        # What the nodes do not account for is counted separately.
        rest = max(0, taken_us - sum(node.duration_us for node in nodes))
        modules[OUTSIDE][index] += rest
        operators[OUTSIDE][index] += rest
    by_cost = (
        sorted(sums.items(), key=lambda item: (item[0] == OUTSIDE, -item[1].sum()))
        for sums in (modules, operators)
    )
    modules_us, operators_us = (
        {name: tuple(samples.tolist()) for name, samples in part} for part in by_cost
    )
    return Breakdown(modules_us, operators_us)
