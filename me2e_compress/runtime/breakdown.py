"""Where the time of an inference goes: by module and by operator."""

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

from me2e_compress.errors import ProviderError
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.latency_trace import Microseconds
from me2e_compress.runtime.optimized import optimized, origins, with_unique_names
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

MOST_EVENTS = 200_000
"""Nodes times inferences that are recorded: onnxruntime holds half a kilobyte of each
until the end, and drops those beyond a million."""
BETWEEN = "(between nodes)"
"""What an inference takes beside its nodes; the profiler's own work is in it."""
NOWHERE = "(no module)"
_KERNEL = "_kernel_time"


@dataclasses.dataclass(frozen=True)
class Breakdown:
    """The time of every inference, divided in two ways; each way adds up to all of it.

    Attributes:
        modules_us: by module, most first; nodes of none are under :data:`NOWHERE`,
            what is outside of nodes under :data:`BETWEEN`.
        operators_us: by operator as it runs: ``FusedConv``, ``QGemm``.
    """

    modules_us: Microseconds
    operators_us: Microseconds


@dataclasses.dataclass(frozen=True)
class NodeRun:
    """One node in one inference.

    Attributes:
        name: of the node that runs.
        operator: of it.
        begin_us: when it began, on the profiler's clock.
        taken_us: how long it took, nodes of its bodies included.
    """

    name: str
    operator: str
    begin_us: int
    taken_us: int


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

    A node that onnxruntime's optimizer made counts where the node counts that it
    stands for.

    Args:
        model: the graph; it stays as it is.
        module_of: the module of a node of it.
        frames: what it sees, repeated as often as it takes.
        runs: inferences that count; fewer where that is more than
            :data:`MOST_EVENTS`.
        warm_up: inferences before.
        threads: of onnxruntime.
        provider: what runs it; its nodes must run on the CPU.
        on_run: called with inferences done and to do.

    Raises:
        ProviderError: the provider runs nodes elsewhere.
        GraphError: the model cannot be run.
        FramesError: a frame does not fit.
    """
    if provider.native != CPU.native:
        raise ProviderError(
            f"provider {provider.name}: times of nodes are measured on the CPU alone"
        )
    source = with_unique_names(model)
    modules = {
        str(copy.name): module_of(node)
        for node, copy in zip(model.graph, source.graph, strict=True)
    }
    found = optimized(source, provider)
    made_of = origins(source, found)
    places = {name: modules[str(node.name)] for name, node in made_of.items()}
    wanted = max(1, min(runs, MOST_EVENTS // max(1, len(found.graph))))
    with tempfile.TemporaryDirectory(prefix="me2e-profile-") as folder:
        session = Session(
            source, threads=threads, provider=provider, profiled=Path(folder)
        )
        counted = _profiled(session, frames, wanted, warm_up, on_run)
    return _divided(counted, places)


def _profiled(
    session: Session,
    frames: Frames,
    wanted: int,
    warm_up: int,
    on_run: Callable[[int, int], None],
) -> list[tuple[int, list[NodeRun]]]:
    """Run a session that records its nodes; read what the wanted inferences took."""
    endless = chain.from_iterable(repeat(frames))
    replayed = islice(replay(session, endless), warm_up + wanted)
    for done, _ in enumerate(replayed, 1):
        on_run(max(0, done - warm_up), wanted)
    with session.end_profile().open(encoding="utf-8") as lines:
        return list(islice(node_runs(lines), warm_up, None))


def node_runs(lines: Iterable[str]) -> Iterator[tuple[int, list[NodeRun]]]:
    """Read what onnxruntime's profiler wrote, an event a line.

    Nodes in the body of an If, Loop or Scan are left out: the node that has the body
    includes them.

    Yields:
        Of every inference its time in microseconds, and its nodes in their order.
    """
    nodes: list[NodeRun] = []
    for line in lines:
        event = _event(line)
        if event.get("cat") == "Node" and str(event["name"]).endswith(_KERNEL):
            begin = int(event["ts"])
            while nodes and nodes[-1].begin_us >= begin:  # inside of this one
                nodes.pop()
            name = str(event["name"]).removesuffix(_KERNEL)
            operator = str(event["args"]["op_name"])
            nodes.append(NodeRun(name, operator, begin, int(event["dur"])))
        elif event.get("name") == "model_run":
            yield int(event["dur"]), nodes
            nodes = []


def _event(line: str) -> dict[str, Any]:
    text = line.strip().rstrip(",")
    if not text.startswith("{"):
        return {}
    found: dict[str, Any] = json.loads(text)
    return found


def _divided(
    runs: Sequence[tuple[int, Sequence[NodeRun]]], places: Mapping[str, str]
) -> Breakdown:
    """Add up the nodes of every inference by module, and by operator."""
    modules, operators = _Sums(len(runs)), _Sums(len(runs))
    for index, (taken_us, nodes) in enumerate(runs):
        for node in nodes:
            modules.add(places.get(node.name) or NOWHERE, index, node.taken_us)
            operators.add(node.operator, index, node.taken_us)
        rest = max(0, taken_us - sum(node.taken_us for node in nodes))
        modules.add(BETWEEN, index, rest)
        operators.add(BETWEEN, index, rest)
    return Breakdown(modules.found(), operators.found())


class _Sums:
    """Sums by name and inference."""

    def __init__(self, runs: int) -> None:
        self._sums = defaultdict[str, Any](lambda: np.zeros(runs, np.int64))

    def add(self, name: str, run: int, taken_us: int) -> None:
        self._sums[name][run] += taken_us

    def found(self) -> Microseconds:
        """Return the sums, the largest share first, what is between nodes last."""
        order = sorted(
            self._sums.items(), key=lambda item: (item[0] == BETWEEN, -item[1].sum())
        )
        return {name: tuple(map(int, sums.tolist())) for name, sums in order}
