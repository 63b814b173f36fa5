"""Compare two graphs on the same frames: outputs, plans, the first difference."""

import dataclasses
import itertools
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.display import Table, plural, table
from me2e_compress.base.errors import (
    EvaluationError,
    FramesError,
    GraphError,
    ModuleMapError,
)
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.calibration.calibrator import Extremes
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.statistics import first_bad_node, index_inputs
from me2e_compress.commands.checks import model_path, opened
from me2e_compress.commands.options import CompareOptions, GraphOptions
from me2e_compress.commands.result import Result, View
from me2e_compress.commands.runtime_loss import (
    RuntimeLoss,
    RuntimeTally,
    has_int8_kernels,
)
from me2e_compress.fidelity import ALIVE
from me2e_compress.fidelity.compare import (
    Fidelity,
    SetFidelity,
    SetTally,
    common_adapter,
)
from me2e_compress.fidelity.compare import compare as measure
from me2e_compress.fidelity.engine_loss import (
    BorderValue,
    FirstDifference,
    find_first_difference,
)
from me2e_compress.fidelity.liveness import Liveness, LivenessTally
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.assign import assign, map_of
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime.convert import slow_here


@dataclasses.dataclass(frozen=True, repr=False)
class Comparison:
    """How far a graph is from another, over frames."""

    fidelity: Fidelity
    liveness: Liveness | None  # None if it was not asked for
    runtime: RuntimeLoss | None  # what the runtime's int8 answers otherwise, if any
    # Of outputs that the metadata `me2e.sets` names and both graphs have
    agents: SetFidelity | None


@dataclasses.dataclass(frozen=True, repr=False)
class CompareResult(Comparison, Result):
    """How close a graph stays to another, and what puts that in doubt."""

    keys = (
        "*fidelity",
        "agents",
        "liveness",
        "runtime",
        "slow_here",
        "known",
        "not_finite",
    )
    reference: Path
    candidate: Path
    slow_here: Mapping[str, str]  # why int8 is slow on this CPU, by file name
    known: str  # from where state and plan are known
    not_finite: tuple[str, ...]  # which node is first to make NaN, by graph

    def view(self) -> View:
        """Return how far outputs, agents and the plan moved, and dead outputs."""
        # How far the plan moves, if it is known
        fidelity, liveness = self.fidelity, self.liveness
        frames = plural(fidelity.frames, "frame")
        headline = f"plan displacement: not measured ({fidelity.plan_reason})"
        if fidelity.plan is not None:
            headline = (
                f"plan displacement: mean {fidelity.plan.mean_m:.4f} m, largest"
                f" {fidelity.plan.max_m:.4f} m over {frames}"
            )
            if fidelity.same_choice is not None:
                share = f"{fidelity.same_choice:.1%} of them"
                headline += f"; the same candidate on {share}"
        # How far outputs are apart, and whether they move
        tables = [outputs_table(f"Fidelity over {frames}", fidelity, self.agents)]
        lines = [self.known, headline] if self.known else [headline]
        faults: Sequence[str] = ()
        if liveness is not None:
            tables += [liveness.table()] if liveness.outputs else []
            lines += liveness.lines()
            faults = liveness.faults
        # Where onnxruntime answers otherwise, or is slow
        lines += () if self.runtime is None else self.runtime.lines()
        lines += (f"{name}: {why}" for name, why in self.slow_here.items())
        alerts = (*fidelity.stray_texts, *self.not_finite, *faults)
        dead = f"{self.candidate}: {'; '.join(faults)}"
        error = EvaluationError(dead) if faults else None
        return View(headline, tables, lines, alerts, error)


def outputs_table(
    title: str,
    fidelity: Fidelity,
    agents: SetFidelity | None,
    floors: Mapping[str, str] | None = None,
) -> Table:
    """Return the SQNR and largest error of every output; with `floors`, their words."""
    matched, n = {} if agents is None else agents.sqnr_db, 4 + (floors is not None)
    rows = [
        (
            output.name,
            f"{matched.get(output.name, output.sqnr_db):z.1f}",
            "matched agents" if output.name in matched else output.by_frame,
            "" if output.name in matched else f"{output.error:.1e}",
            *([] if floors is None else [floors.get(output.name, "above")]),
        )
        for output in fidelity.outputs
    ]
    columns = ("output", "SQNR dB", "by frame", "max|a-b|/max|a|", "floor")[:n]
    rows += [(name, "removed", *[""] * (n - 2)) for name in fidelity.missing]
    # Outputs that are sets are compared agent by agent
    note = ""
    if agents is not None:
        note = (
            "matched: agents with a score of 0.5 or more, each against the nearest. The"
            f" first graph has {plural(agents.agents, 'agent')} of such scores, the"
            f" second one within 2 m of {agents.matched} of them."
        )
    return table(title, columns, rows, note)


def compare(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    options: CompareOptions | None = None,
    listener: Listener = SILENT,
) -> CompareResult:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres.

    Each graph is an ONNX file or the name of a model that ships. Outputs that the
    metadata ``me2e.sets`` of the first names are matched agent by agent. The option
    ``as_it_stands`` runs the first graph without onnxruntime's optimizations and the
    second with all of them: comparing a graph with itself shows what they change. An
    output is dead whose standard deviation over the frames is less than a share
    ``alive`` of the first graph's.

    Raises:
        GraphError: A model does not exist or run, or nothing picks one of a plan's
            modes.
        FramesError: A frame does not fit one of the graphs.
        ProviderError: The provider is not available.
        EvaluationError: The graphs share no output, or one is not finite.
    """
    options = options or CompareOptions()
    paths = model_path(reference), model_path(candidate)
    recording, provider = CalibrationSet(Path(frames)), options.runs_on
    # each graph must take the frames, and open in another process first
    graphs = {
        path: opened(path, recording, options, listener, paths)
        for path in dict.fromkeys(paths)
    }
    slow = {
        path.name: why
        for path, opening in graphs.items()
        if (why := slow_here(opening.model, provider))
    }
    total = len(recording)

    def with_progress(frame: Frame) -> Frame:
        listener.on_progress("frames", frame.index, total, "")
        return frame

    # the sessions get the adapter's metadata, which the files lack
    def session(path: Path, *, optimize: bool = True, stock: bool = False) -> Session:
        return Session(
            path, optimize=optimize, stock=stock, release=True, provider=provider,
            metadata=graphs[path].metadata,
        )  # fmt: skip

    left = session(paths[0], optimize=not options.as_it_stands)
    right = session(paths[1], stock=options.as_it_stands)
    try:
        common_adapter(left, right)
        sets = SetTally.of(left, right)
    except GraphError as error:
        raise GraphError(f"{paths[0]}: {error}") from error
    # the runtime's int8, beside the nodes as they stand
    kernels, model = None, graphs[paths[1]].model
    if not options.as_it_stands and has_int8_kernels(model, provider):
        kernels = session(paths[1], stock=True)
    shown_frames, bad_frame = map(with_progress, recording), _BadFrame()
    comparison = compare_sessions(
        left, right, shown_frames, model, kernels, sets, bad_frame, alive=options.alive
    )
    # Name the nodes that make NaN or infinity, once
    makers = dict[str, str]()
    for path, opened_session in zip(paths, (left, right), strict=True):
        if made := bad_frame.maker(graphs[path].model.clone(), opened_session):
            makers.setdefault(made, f"{path.name}: {made}")
    return CompareResult(
        comparison.fidelity,
        comparison.liveness,
        comparison.runtime,
        comparison.agents,
        reference=paths[0],
        candidate=paths[1],
        slow_here=slow,
        known="; ".join(dict.fromkeys(graphs[path].known for path in paths)),
        not_finite=tuple(makers.values()),
    )


class _BadFrame:
    """Keeps the first frame, or the first of which an output holds NaN or infinity."""

    def __init__(self) -> None:
        self._frame: Frame | None = None
        self._is_bad = False

    def add(
        self, left: Mapping[str, Array], right: Mapping[str, Array], frame: Frame
    ) -> None:
        """Look at a frame's outputs of two graphs."""
        floats = [v for v in (*left.values(), *right.values()) if v.dtype.kind == "f"]
        if not self._is_bad and not all(np.isfinite(array).all() for array in floats):
            self._frame, self._is_bad = frame, True
        self._frame = self._frame or frame

    def maker(self, model: ir.Model, session: Session) -> str:
        """Describe the first node that makes NaN or infinity in a scene; else ""."""
        graph.infer_shapes(model)  # untyped values are not looked at
        places, frame = index_inputs(model), self._frame
        if frame is None or not (places or self._is_bad):
            return ""
        read, probe = {*places, *session.outputs}, Extremes()
        try:
            inputs = {**frame.arrays, **session.first_state(frame.arrays)}
            return first_bad_node(model, inputs, read, probe, session.provider)
        except (GraphError, FramesError):  # it runs optimized alone
            return ""


def compare_sessions(
    reference: Session,
    candidate: Session,
    frames: Iterable[Frame],
    model: ir.Model,
    kernels: Session | None = None,
    sets: SetTally | None = None,
    bad_frame: _BadFrame | None = None,
    *,
    alive: float = ALIVE,
) -> Comparison:
    """Run two sessions over frames, and tally how far outputs are apart and move.

    `model` is the candidate's graph, `kernels` runs it by onnxruntime's int8; outputs
    of both are added to `sets` and `bad_frame`. With `alive` 0 no output is dead.
    """
    # What is tallied, frame by frame, while both sessions run
    liveness = LivenessTally(reference, candidate) if alive else None
    frames, for_kernels = itertools.tee(frames)
    runtime = None if kernels is None else RuntimeTally(kernels, for_kernels, sets)
    del for_kernels  # tee would store every frame that it has not read
    tallies = (sets, bad_frame, liveness, runtime)
    watchers = [tally.add for tally in tallies if tally is not None]
    fidelity = measure(reference, candidate, frames, watchers)
    agents = None if sets is None else sets.result()
    return Comparison(
        fidelity,
        None if liveness is None else liveness.result(alive),
        None if runtime is None else runtime.result(model, fidelity, agents),
        agents,
    )


FRAMES = 2  # the second frame is compared: it reads the state of the first


@dataclasses.dataclass(frozen=True, repr=False)
class FirstDifferenceResult(Result):
    """Where a graph begins to differ from its source."""

    keys = ("*difference",)
    reference: Path
    candidate: Path
    difference: FirstDifference

    def view(self) -> View:
        """Return the worst value that each module hands on."""
        worst: dict[str, BorderValue] = {}
        for value in self.difference.values:
            if value.sqnr_db < worst.setdefault(value.module, value).sqnr_db:
                worst[value.module] = value
        rows = [
            (value.module or "-", value.value, value.node, f"{value.sqnr_db:z.1f}")
            for value in worst.values()
        ]
        columns = ("module", "worst value", "node", "SQNR dB")
        note = (
            f"Of {plural(len(self.difference.values), 'value')} that modules hand on."
            f" {self.difference.unknown} of either graph have no namesake in the other."
        )
        modules = table("Modules", columns, rows, note, words=3)
        return View(headline_of(self.difference), [modules])


def headline_of(difference: FirstDifference) -> str:
    """Return the line that names the first module that differs, if one does."""
    floor_db, count = f"{difference.floor_db:g} dB", len(difference.values)
    if difference.first is not None:
        return f"first below {floor_db}: {difference.first}"
    below = sum(value.sqnr_db < difference.floor_db for value in difference.values)
    if not below:
        return f"no difference: {plural(count, 'value')} at {floor_db} or more"
    return f"{below} of {plural(count, 'value')} are below {floor_db}, but no output is"


def first_difference(
    reference: str | Path,
    candidate: str | Path,
    frames: str | Path,
    options: GraphOptions | None = None,
    listener: Listener = SILENT,
) -> FirstDifferenceResult:
    """Find the first module after which the second graph differs.

    Both graphs run on one frame, their nodes as they stand, and what their modules hand
    on is compared by name. A value differs below 80 dB, or below 20 dB where a graph
    holds int8 or mostly narrow floats.

    Raises:
        EvaluationError: The graphs share no value.
        FramesError: A frame does not fit one of the graphs.
        GraphError: A model does not exist or run.
        ProviderError: The provider is not available.
    """
    options = options or GraphOptions()
    paths = model_path(reference), model_path(candidate)
    recording = CalibrationSet(Path(frames))
    models = {
        path: stamp_modules(opened(path, recording, options, listener, paths).model)
        for path in dict.fromkeys(paths)
    }
    # Hold both graphs together on a frame that has a state
    shown = tuple(itertools.islice(recording, FRAMES))
    first, second = (models[path] for path in paths)
    difference = find_first_difference(first, second, shown, options.runs_on)
    return FirstDifferenceResult(*paths, difference)


def stamp_modules(model: ir.Model) -> ir.Model:
    """Write every node's module into its metadata, if missing; return the model."""
    # By the preset's map, or as one module where it does not fit
    if provenance.missing(model):
        try:
            placed = assign(model, map_of(model, None))
        except ModuleMapError:  # names that the preset needs are lost
            placed = assign(model, ModuleMap.whole())
        for node, place in placed.placements.items():
            if provenance.read(node) is None:
                past = provenance.Provenance(place.module, (node.name or "",))
                provenance.stamp(node, past)
    return model
