"""How close one graph stays to another on the same frames."""

import dataclasses
from pathlib import Path

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import GraphError
from me2e_compress.fidelity.compare import Fidelity, common_adapter
from me2e_compress.fidelity.compare import compare as measure
from me2e_compress.fidelity.matched_sets import SetFidelity
from me2e_compress.fidelity.open_loop import OpenLoopTally
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.stack.stack_session import open_session
from me2e_compress.workflows.adapted import adapted
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.first_try import load_interface, try_model
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.plan_quality import OpenLoop
from me2e_compress.workflows.result import Result, Table, counted, table


@dataclasses.dataclass(frozen=True, repr=False)
class CompareResult(Result):
    """How close a graph stays to another.

    Attributes:
        reference: the graph to be true to.
        candidate: the graph that is judged.
        fidelity: output by output, and of the plan.
        open_loop: both plans against what was really driven; None where it was not
            measured.
        open_loop_reason: why not; empty where it was.
    """

    reference: Path
    candidate: Path
    fidelity: Fidelity
    open_loop: OpenLoop | None = None
    open_loop_reason: str = ""

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
        """Return signal to noise of every output, then sets, then plans as driven."""
        found = self.fidelity
        rows = [
            *((o.name, f"{o.sqnr_db:.1f}", f"{o.error:.1e}") for o in found.outputs),
            *((name, "removed", "") for name in found.missing),
        ]
        title = f"Fidelity over {counted(found.frames, 'frame')}"
        outputs = table(title, ("output", "SQNR dB", "max|a-b|/max|a|"), rows)
        agents = () if found.agents is None else (_agents(found.agents),)
        driven = () if self.open_loop is None else (self.open_loop.table(),)
        return (outputs, *agents, *driven)

    def records(self) -> list[dict[str, object]]:
        """Return a row an output."""
        return [dataclasses.asdict(each) for each in self.fidelity.outputs]

    def to_json(self) -> object:
        """Return outputs, missing outputs, plan, number of frames, plans as driven."""
        driven = None if self.open_loop is None else dataclasses.asdict(self.open_loop)
        return {
            **dataclasses.asdict(self.fidelity),
            "open_loop": driven,
            "open_loop_reason": self.open_loop_reason,
        }


def _agents(found: SetFidelity) -> Table:
    rows = [(name, f"{decibels:.1f}") for name, decibels in found.sqnr_db.items()]
    agents = counted(found.agents, "agent")
    away = (
        "" if found.centre_m is None else f", {found.centre_m:.2f} m apart on average"
    )
    return table(
        "Agents with a score of 0.5 or more, each against the nearest",
        ("output", "SQNR dB"),
        rows,
        f"The first graph scores {agents} at 0.5 or more. The second has an agent "
        f"within 2 m of {found.found} of them{away}, scores {found.kept} of those at "
        f"0.5 or more, and {found.added} where the first has none.",
    )


def compare(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    listener: Listener = SILENT,
    *,
    as_it_stands: bool = False,
    provider: Provider = CPU,
    adapter: str | Path | None = None,
) -> CompareResult:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Where the frames tell what was really driven, also L2 and collisions of both plans.

    Args:
        reference: the graph to be true to: a file, the TOML of a stack of several, or
            the name of one that ships.
        candidate: the graph that is judged.
        frames: folder of recorded frames.
        listener: is called with progress and warnings.
        as_it_stands: run the first graph without onnxruntime's optimizations, and the
            second with all of them: a graph held against itself shows what they change.
        provider: what runs both.
        adapter: TOML file that says which output is the plan and which are fed back,
            in both graphs; None leaves it to their metadata.

    Raises:
        GraphError: no such model, onnxruntime cannot run it, or its plan has several
            modes and nothing picks one.
        FramesError: a frame fits one of the graphs not.
        ProviderError: the provider is not there.
        EvaluationError: no output in common, or one that is not finite.
    """
    paths = model_path(reference), model_path(candidate)
    recording = CalibrationSet(Path(frames))
    said = dict[Path, dict[str, str]]()
    for path in dict.fromkeys(paths):
        model = load_interface(path)
        said[path] = adapted(model, adapter)
        recording.check(model)
        try_model(model, path, recording, listener, provider)
    total = len(recording)

    def reported(frame: Frame) -> Frame:
        listener.on_progress("frames", frame.index, total, "")
        return frame

    left = open_session(
        paths[0], optimize=not as_it_stands, release=True, provider=provider,
        said=said[paths[0]],
    )  # fmt: skip
    right = open_session(
        paths[1], stock=as_it_stands, release=True, provider=provider,
        said=said[paths[1]],
    )  # fmt: skip
    try:
        read, reason = common_adapter(left, right)
    except GraphError as error:
        raise GraphError(f"{paths[0]}: {error}") from error
    tally = None if read is None else OpenLoopTally(read)
    watch = None if tally is None else tally.add
    fidelity = measure(left, right, map(reported, recording), watch)
    driven = reason if tally is None else OpenLoop.of(tally)
    if isinstance(driven, str):
        return CompareResult(*paths, fidelity, None, driven)
    return CompareResult(*paths, fidelity, driven)
