"""Compare the outputs and plans of two graphs on the same frames."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.adapter.outputs import adapted
from me2e_compress.errors import EvaluationError, GraphError
from me2e_compress.fidelity.compare import (
    Fidelity,
    SetFidelity,
    SetOutputs,
    SetTally,
    common_adapter,
)
from me2e_compress.fidelity.compare import compare as measure
from me2e_compress.fidelity.floor import ALIVE
from me2e_compress.fidelity.liveness import Liveness, LivenessTally
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime import slow_here
from me2e_compress.workflows.checks import check_number, model_path
from me2e_compress.workflows.first_opening import try_first
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Status, Table, counted, table
from me2e_compress.workflows.runtime_loss import (
    RuntimeLoss,
    RuntimeTally,
    has_int8_kernels,
)


@dataclasses.dataclass(frozen=True, repr=False)
class CompareResult(Result):
    """How close a graph stays to another.

    `agents` is None unless the metadata ``me2e.sets`` names outputs that both graphs
    have. `liveness` is None if it was not asked for; `runtime`, what onnxruntime's
    int8 answers otherwise, if there is none to ask.
    `slow_here` tells by file name of int8 whose form is slow on this CPU.
    """

    reference: Path
    candidate: Path
    fidelity: Fidelity
    agents: SetFidelity | None = None
    liveness: Liveness | None = None
    runtime: RuntimeLoss | None = None
    slow_here: Mapping[str, str] = dataclasses.field(default_factory=dict)

    @property
    def status(self) -> Status:
        """``refused`` if an output of the second graph is dead."""
        return "refused" if self.alerts() else "ok"

    def check(self) -> None:
        """Raise EvaluationError if an output of the second graph is dead."""
        if dead := self.alerts():
            raise EvaluationError(f"{self.candidate}: {'; '.join(dead)}")

    def lines(self) -> tuple[str, ...]:
        """Return how far the plan moved, which outputs answer, and what is slow."""
        alive = () if self.liveness is None else self.liveness.lines()
        runtime = () if self.runtime is None else self.runtime.lines()
        slow = (f"{name}: {why}" for name, why in self.slow_here.items())
        return (self.headline, *alive, *runtime, *slow)

    def alerts(self) -> tuple[str, ...]:
        """Return the outputs that are dead, and states that are not fed."""
        return () if self.liveness is None else self.liveness.faults

    @property
    def headline(self) -> str:
        """How far the plan moved."""
        found = self.fidelity
        if found.plan is None:
            return f"plan displacement: not measured ({found.plan_reason})"
        said = (
            f"plan displacement: mean {found.plan.mean_m:.4f} m, largest"
            f" {found.plan.max_m:.4f} m over {counted(found.frames, 'frame')}"
        )
        if found.same_choice is None:
            return said
        return f"{said}; the same candidate on {found.same_choice:.1%} of them"

    def tables(self) -> tuple[Table, ...]:
        """Return outputs, how they answer, and agents."""
        found = self.fidelity
        rows = [
            *((o.name, f"{o.sqnr_db:.1f}", f"{o.error:.1e}") for o in found.outputs),
            *((name, "removed", "") for name in found.missing),
        ]
        title = f"Fidelity over {counted(found.frames, 'frame')}"
        outputs = table(title, ("output", "SQNR dB", "max|a-b|/max|a|"), rows)
        agents = () if self.agents is None else (_agents(self.agents),)
        alive = self.liveness is not None and self.liveness.outputs
        lively = (self.liveness.table(),) if self.liveness and alive else ()
        return (outputs, *lively, *agents)

    def to_json(self) -> object:
        """Return the fidelity, agents, and liveness."""
        return {
            **dataclasses.asdict(self.fidelity),
            "agents": self.agents,
            "liveness": self.liveness,
            "runtime": self.runtime,
            "slow_here": self.slow_here,
        }


def _agents(found: SetFidelity) -> Table:
    rows = [(name, f"{decibels:.1f}") for name, decibels in found.sqnr_db.items()]
    agents = counted(found.agents, "agent")
    return table(
        "Agents with a score of 0.5 or more, each against the nearest",
        ("output", "SQNR dB"),
        rows,
        f"The first graph scores {agents} at 0.5 or more. The second has an agent "
        f"within 2 m of {found.matched} of them.",
    )


def _set_tally(left: Session, right: Session) -> SetTally | None:
    """Return what matches agents; None where no set is named, or one graph lacks it."""
    shapes = {name: port.shape for name, port in left.outputs.items()}
    outputs = SetOutputs.of(left.metadata, shapes)
    if outputs is None or not set(outputs.names) <= set(right.outputs):
        return None
    return SetTally(outputs)


def compare(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    listener: Listener = SILENT,
    *,
    as_it_stands: bool = False,
    alive: float = ALIVE,
    provider: Provider = CPU,
    adapter: str | Path | None = None,
    module_map: str | Path | None = None,
) -> CompareResult:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Each graph is an ONNX file or the name of a model that ships. Outputs that the
    metadata ``me2e.sets`` of the first names are matched agent by agent. `as_it_stands`
    runs the first graph without onnxruntime's optimizations and the second with all of
    them: comparing a graph with itself shows what they change. An output is dead whose
    standard deviation over the frames is less than a share `alive` of the first
    graph's; 0 does not ask. The adapter's TOML says which output is the plan and which
    are fed back, in both graphs; None leaves it to their metadata.

    Raises:
        GraphError: A model does not exist or run, or nothing picks one of a plan's
            modes.
        FramesError: A frame does not fit one of the graphs.
        ProviderError: The provider is not available.
        EvaluationError: The graphs share no output, or one is not finite.
    """
    check_number("--alive", alive, zero=True, most=1.0)
    paths = model_path(reference), model_path(candidate)
    recording = CalibrationSet(Path(frames))
    said, models = dict[Path, dict[str, str]](), list[ir.Model]()
    slow = dict[str, str]()
    # each graph must take the frames, and open in another process first
    for path in dict.fromkeys(paths):
        loaded = graph.load(path)
        said[path] = adapted(loaded, adapter, module_map)
        models.append(loaded)
        if why := slow_here(loaded, provider):
            slow[path.name] = why
        recording.check(loaded)
        try_first(
            loaded, path.name, recording, listener=listener, file=path,
            provider=provider,
        )  # fmt: skip
    total = len(recording)

    def reported(frame: Frame) -> Frame:
        listener.on_progress("frames", frame.index, total, "")
        return frame

    # the sessions get the adapter's metadata, which the files lack
    left = Session(
        paths[0], optimize=not as_it_stands, release=True, provider=provider,
        said=said[paths[0]],
    )  # fmt: skip
    right = Session(
        paths[1], stock=as_it_stands, release=True, provider=provider,
        said=said[paths[1]],
    )  # fmt: skip
    try:
        common_adapter(left, right)
        sets = _set_tally(left, right)
    except GraphError as error:
        raise GraphError(f"{paths[0]}: {error}") from error
    lively = LivenessTally(left, right) if alive else None
    # what onnxruntime's int8 answers, beside the nodes as they stand
    kernels = None
    if not as_it_stands and has_int8_kernels(models[-1], provider):
        third = Session(
            paths[1], stock=True, release=True, provider=provider, said=said[paths[1]]
        )
        kernels = RuntimeTally(third, recording)
    watching = [each.add for each in (sets, lively, kernels) if each is not None]

    def watch(a: dict[str, Array], b: dict[str, Array], frame: Frame) -> None:
        for add in watching:
            add(a, b, frame)

    fidelity = measure(left, right, map(reported, recording), watch)
    agents = None if sets is None else sets.result()
    found = CompareResult(*paths, fidelity, agents, slow_here=slow)
    if kernels is not None:
        runtime = kernels.result(models[-1], fidelity)
        found = dataclasses.replace(found, runtime=runtime)
    if lively is not None:
        found = dataclasses.replace(found, liveness=lively.result(alive))
    return found
