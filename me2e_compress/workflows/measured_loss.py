"""What lossy passes, and onnxruntime's own int8, did to a model's outputs."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import hold_out
from me2e_compress.display import Table, counted, table
from me2e_compress.errors import EvaluationError, FramesError, GraphError
from me2e_compress.fidelity.compare import Fidelity, Reference, Tally
from me2e_compress.fidelity.floor import Floor, Rounding, Shortfall, shown
from me2e_compress.fidelity.liveness import Liveness, LivenessTally
from me2e_compress.manager import Report
from me2e_compress.manager.runtime_levels import first_node
from me2e_compress.manager.verification_inputs import VerificationInputs, relative
from me2e_compress.passes import Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.decision import plan_of
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.latency_trace import cpu_seconds
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay
from me2e_compress.shipped.drivers import sample_frames
from me2e_compress.targets import TARGETS
from me2e_compress.targets.onnxruntime import int8_rewrites
from me2e_compress.targets.quantized import describe_quantized
from me2e_compress.workflows.result import Listener

NOT_ASKED = "--measure-frames 0"

FEW_NODES = 3
"""So many int8 nodes are named where the loss is."""

FEW = 3
"""Fewer frames say little: four of one drive lay 12 to 15 dB from four others."""


@dataclasses.dataclass(frozen=True)
class RuntimeLoss:
    """How onnxruntime's int8 kernels compute an int8 graph on this processor.

    Attributes:
        sqnr_db: SQNR of the outputs that they answer otherwise than the nodes, dB.
        nodes_db: SQNR of the same outputs by the nodes as they stand, dB.
        causes: layers, and what is done to them; the first node, where no rule knows.
    """

    sqnr_db: Mapping[str, float]
    nodes_db: Mapping[str, float]
    causes: tuple[str, ...] = ()

    def lines(self) -> Iterator[str]:
        """Yield what the runtime answers otherwise, and why; nothing if it does not."""
        if not self.sqnr_db:
            return
        apart = ", ".join(
            f"{name} {value:z.1f} dB (its nodes {self.nodes_db[name]:z.1f})"
            for name, value in self.sqnr_db.items()
        )
        yield f"onnxruntime's int8 answers otherwise than the file: {apart}"
        more = len(self.causes) - _NAMED
        for cause in self.causes[:_NAMED]:
            yield f"the runtime's, not the file's: {cause}"
        if more > 0:
            yield f"the runtime's, not the file's: {more} layers more (lint names them)"


@dataclasses.dataclass(frozen=True)
class MeasuredLoss:
    """How true a compressed model stayed, and where it did not.

    Attributes:
        fidelity: fidelity to the graph before the first lossy pass; None if not
            measured.
        on: which frames were used, or why nothing was measured, in words.
        incomparable: whether an output is not finite, or of another shape than before.
        unsteady: outputs that are not judged, with what they fall to in `rounding`:
            they pick between near-equal candidates.
        rounding: outputs below the floor that fall below it, uncompressed, when the
            largest input alone is rounded; None if nothing is below.
        shortfalls: outputs below the floor, the worst first.
        guilty: the lossy passes, which cause the shortfalls between them.
        int8_nodes: the nodes that are int8, where they are three at most.
        advice: the command that measures int8 module by module; empty where nothing is
            below the floor, or nothing is int8.
        liveness: which outputs still move; None if not asked.
        runtime: what onnxruntime's int8 answers otherwise; None if it is not for it.
        seconds: CPU time of measuring.
    """

    fidelity: Fidelity | None
    on: str
    floor: Floor
    unsteady: Mapping[str, float] = dataclasses.field(default_factory=dict)
    rounding: Rounding | None = None
    liveness: Liveness | None = None
    runtime: RuntimeLoss | None = None
    shortfalls: tuple[Shortfall, ...] = ()
    guilty: tuple[str, ...] = ()
    int8_nodes: tuple[str, ...] = ()
    advice: str = ""
    seconds: float = 0.0
    incomparable: bool = False

    def lines(self) -> Iterator[str]:
        """Yield how far the outputs moved, and which are alive or not judged."""
        found = self.fidelity
        if found is not None:
            parts = list[str]()
            if found.plan is not None:
                parts.append(
                    f"the plan moves {found.plan.mean_m:.3f} m on average,"
                    f" {found.plan.max_m:.2f} m at most"
                )
            judged = [
                each
                for each in found.outputs
                if each.name != found.plan_output
                and not (each.discrete or each.name in self.unsteady)
            ]
            if judged:
                worst = min(judged, key=lambda each: each.sqnr_db)
                noise, spread = shown(worst.sqnr_db, "dB"), worst.by_frame
                spread = f" ({spread} by frame)" if spread else ""
                parts.append(f"the noisiest output is {worst.name}, {noise}{spread}")
            where = f"on {counted(found.frames, 'frame')} {self.on}"
            yield f"{'; '.join(parts) or 'no output could be judged'} ({where})"
        elif self.on != NOT_ASKED:
            yield f"fidelity: not measured ({self.on})"
        if found is not None and self.rounding is not None:
            yield from self._rounded(found, self.rounding)
        if self.liveness is not None:
            yield from self.liveness.lines()
        if self.runtime is not None:
            yield from self.runtime.lines()

    def alerts(self) -> Iterator[str]:
        """Yield what cannot be compared or is below the floor, and what helps."""
        if self.incomparable:
            yield f"the outputs cannot be compared: {self.on}"
        if self.liveness is not None:
            yield from self.liveness.faults
        if self.fidelity is not None and self.fidelity.frames < FEW:
            yield (
                f"this verdict rests on {counted(self.fidelity.frames, 'frame')}:"
                f" record {4 * FEW} or more, a quarter of which is measured on"
            )
        if self.fidelity is not None:
            yield from self.fidelity.strays
        if self.shortfalls:
            low, guilty = ", ".join(map(str, self.shortfalls)), ", ".join(self.guilty)
            nodes = f" ({', '.join(self.int8_nodes)})" if self.int8_nodes else ""
            yield f"below the floor ({self.floor}): {low}; lost in {guilty}{nodes}"
        if self.advice:
            yield f"{self.advice} measures which modules lose it"

    def table(self) -> Table | None:
        """Return the SQNR and largest error of every output; None if not measured."""
        found = self.fidelity
        if found is None:
            return None
        below = {each.output for each in self.shortfalls}
        said = {
            each.name: "not judged: whole numbers"
            for each in found.outputs
            if each.discrete
        }
        said |= dict.fromkeys(self.unsteady, "not judged: it picks")
        said |= dict.fromkeys(below, "below")
        rows = [
            (
                each.name,
                f"{each.sqnr_db:z.1f}",
                each.by_frame,
                f"{each.error:.1e}",
                said.get(each.name, "above"),
            )
            for each in found.outputs
        ]
        rows += [(name, "removed", "", "", "") for name in found.missing]
        columns = ("output", "SQNR dB", "by frame", "max|a-b|/max|a|", "floor")
        title = f"Fidelity on {counted(found.frames, 'frame')} {self.on}"
        return table(title, columns, rows)

    def record(self) -> dict[str, object]:
        """Return what the report says of it: all but the time."""
        names = (each.name for each in dataclasses.fields(self))
        return {name: getattr(self, name) for name in names if name != "seconds"}

    def _rounded(self, found: Fidelity, rounding: Rounding) -> Iterator[str]:
        """Say what rounding one input does to the graph before; nothing in silence."""
        plan = "" if found.plan is None else found.plan_output
        for choice in dict.fromkeys(map(rounding.choices.get, rounding.values)):
            low = ", ".join(
                f"{name} ({shown(value, 'm' if name == plan else 'dB')})"
                for name, value in rounding.values.items()
                if rounding.choices.get(name) == choice
            )
            alone = (
                f"{low}: so low falls the graph itself, uncompressed, when only"
                f" {rounding.input} is rounded to int8"
            )
            yield (
                f"not judged: {alone}; it picks between near-equal candidates at"
                f" {choice}, and the road tells what that means"
                if choice
                else f"judged, though int8 may be too coarse for it: {alone}, and"
                " nothing picks on the way"
            )


APART_DB = 6.0
"""From how much more noise on, in dB, an output is named: twice the amplitude."""

QUIET_DB = 30.0
"""Outputs with an SQNR above that are not named: int8 kernels round ties otherwise than
the nodes do, which is 36 dB of the driver's noisiest output (without any overflow)."""

_OVERFLOW = (
    "sums of uint8 by int8 overflow 16 bits on this processor, which has no VNNI: set"
    " session.x64quantprecision to 1, as profile and evaluate do"
)

_NAMED = 5
"""How many layers a line names."""


class RuntimeTally:
    """Compares a graph, as onnxruntime's int8 runs it, with a reference.

    Args:
        session: the graph, with int8 kernels.
        frames: those that the reference is shown.
    """

    def __init__(self, session: Session, frames: Frames) -> None:
        self._answers = replay(session, frames)
        self._tallies: dict[str, Tally] = {}
        self._first: dict[str, float] = {}
        self._frame: Frame | None = None
        self._provider = session.provider

    def add(
        self, reference: dict[str, Array], nodes: dict[str, Array], frame: Frame
    ) -> None:
        """Add a frame: what the reference and the nodes of the graph answered."""
        answers = next(self._answers)
        for name in (each for each in nodes if each in reference):
            tally = self._tallies.setdefault(name, Tally(name))
            tally.add(reference[name], answers[name], frame.index)
            if self._frame is None:
                self._first[name] = relative(nodes[name], answers[name])
        self._frame = self._frame or frame

    def result(self, model: ir.Model, fidelity: Fidelity) -> RuntimeLoss:
        """Return what is noisier than by the nodes, and the causes."""
        nodes = {each.name: each.sqnr_db for each in fidelity.outputs}
        runs = {name: tally.result().sqnr_db for name, tally in self._tallies.items()}
        apart = [
            name
            for name, sqnr in runs.items()
            if sqnr < QUIET_DB and sqnr < nodes[name] and sqnr <= nodes[name] - APART_DB
        ]
        if not apart:
            return RuntimeLoss({}, {})
        shaped = model.clone()
        graph.infer_shapes(shaped)
        causes = [f"{each.node}: {each.message}" for each in int8_rewrites(shaped)]
        worst = max(apart, key=lambda name: self._first[name])
        if not causes and self._overflows(model):
            causes = [_OVERFLOW]
        # else the first node from which the output is half as far off as at last
        elif not causes and self._frame is not None and self._first[worst]:
            inputs = VerificationInputs([self._frame], "recorded", self._provider)
            half = self._first[worst] / 2
            node = first_node(model, worst, "all", half, inputs, int8_kernels=True)
            if node is not None:
                causes = [f"{worst} differs from {node.name} ({node.op_type}) on"]
        return RuntimeLoss(
            {name: runs[name] for name in apart},
            {name: nodes[name] for name in apart},
            tuple(causes),
        )

    def _overflows(self, model: ir.Model) -> bool:
        """Return whether an output is 6 dB nearer its nodes with sums of 32 bits."""
        if self._frame is None:
            return False
        provider, shown = self._provider, [self._frame]
        (nodes,) = replay(Session(model, provider=provider), shown)
        (stock,) = replay(Session(model, stock=True, provider=provider), shown)
        (wide,) = replay(Session(model, int8_kernels=True, provider=provider), shown)

        def noise(name: str, answers: dict[str, Array]) -> float:
            apart = nodes[name].astype(np.float64) - answers[name].astype(np.float64)
            return float(np.square(apart).sum())

        return any(4 * noise(name, wide) < noise(name, stock) for name in nodes)


def has_int8_kernels(model: ir.Model, provider: Provider) -> bool:
    """Return whether onnxruntime would run a graph by int8 kernels of its own."""
    return provider.target == CPU.target and describe_quantized(model) is not None


KEPT_OUT = "kept out of calibration"
SHARED = "calibrated on as well: there is no other"
PERHAPS_SHARED = "that the saved ranges may have been measured on"
SHIPPED_FRAMES = "that ship with the model"
ADVICE = "me2e-compress sensitivity MODEL FRAMES -o RECIPE.toml"


@dataclasses.dataclass(frozen=True)
class SplitFrames:
    """Frames that passes see, and those that the result is measured on.

    Attributes:
        kind: what kind the measured frames are, or why there are none, in words.
        samples: frames that exact passes are checked on where the user gave none.
    """

    calibration: CalibrationSet | None
    measured: Frames | None
    kind: str
    samples: CalibrationSet | None = None


def split_frames(
    source: Path,
    model: ir.Model,
    folder: str | Path | None,
    passes: Sequence[Pass],
    most: int,
) -> SplitFrames:
    """Open the recording, or the frames that ship with the model, and split it.

    Up to `most` frames are kept to measure on, where a pass is lossy; nothing is kept
    out of calibration where ranges are saved.
    """
    recording = samples = None
    if folder is not None:
        recording = CalibrationSet(folder)
        recording.check(model)
    elif (shipped := sample_frames(source)) is not None:
        samples = CalibrationSet(shipped)
    if not most or all(each.exact for each in passes):
        return SplitFrames(recording, None, NOT_ASKED, samples)
    if recording is None:
        reason = "no recorded frames" if samples is None else SHIPPED_FRAMES
        return SplitFrames(None, samples, reason, samples)
    calibration, measured = hold_out(recording, most)
    if any(each.reads_ranges and not each.needs_frames for each in passes):
        return SplitFrames(recording, measured, PERHAPS_SHARED)
    kind = SHARED if len(recording) == 1 else KEPT_OUT
    return SplitFrames(calibration, measured, kind)


def measure_loss(
    report: Report,
    provider: Provider,
    frames: SplitFrames,
    floor: Floor,
    listener: Listener,
) -> MeasuredLoss | None:
    """Compare the graph with that before the first lossy pass; None if all are exact.

    Of what is below the floor, the outputs that choose between near-equal candidates
    are set aside.
    """
    if not report.lossy:
        return None
    loss = MeasuredLoss(None, frames.kind, floor)
    if frames.measured is None:
        return loss
    start = cpu_seconds()
    listener.on_progress("fidelity", 0, 1, "")
    # a graph that does not run or compare is a finding, not a failure
    try:
        loss = _compared(loss, report, provider, frames.measured)
    except (FramesError, GraphError) as error:
        loss = dataclasses.replace(loss, on=str(error))
    except EvaluationError as error:  # not finite, or of another shape
        loss = dataclasses.replace(loss, on=str(error), incomparable=True)
    return dataclasses.replace(loss, seconds=cpu_seconds() - start)


def _compared(
    loss: MeasuredLoss, report: Report, provider: Provider, frames: Frames
) -> MeasuredLoss:
    """Measure; of what is below the floor, tell which outputs are judged."""
    passes = [each.applied for each in report.lossy]
    before, after = report.lossy[0].before, report.model
    open_session = partial(Session, release=True, provider=provider)
    reference, session = Reference.of(open_session(before), frames), open_session(after)
    lively = LivenessTally(reference.session, session)
    # a graph that was written for onnxruntime is run by its int8 kernels, too
    kernels = None
    written = any(
        isinstance(each, LowerInt8)
        or (isinstance(each, QuantizeInt8) and TARGETS.parse(each.target).opens)
        for each in passes
    )
    if written and has_int8_kernels(after, provider):
        kernels = RuntimeTally(open_session(after, stock=True), frames)

    def watch(a: dict[str, Array], b: dict[str, Array], frame: Frame) -> None:
        lively.add(a, b, frame)
        if kernels is not None:
            kernels.add(a, b, frame)

    fidelity = reference.compare(session, watch=watch)
    loss = dataclasses.replace(
        loss,
        fidelity=fidelity,
        liveness=lively.result(),
        runtime=None if kernels is None else kernels.result(after, fidelity),
    )
    low = [each.output for each in loss.floor.shortfalls(fidelity)]
    if not low:
        return loss
    # outputs that choose between near-equal candidates are not judged
    rounding = Rounding.of(reference, before, loss.floor).among(low)
    unsteady = {name: rounding.values[name] for name in rounding.choices}
    below = loss.floor.shortfalls(fidelity, unsteady)
    int8 = any(isinstance(each, QuantizeInt8) for each in passes)
    plan = plan_of(after) if below and int8 else None
    placed = () if plan is None else plan.placed
    return dataclasses.replace(
        loss,
        unsteady=unsteady,
        rounding=rounding,
        shortfalls=below,
        guilty=tuple(each.name for each in passes) if below else (),
        int8_nodes=tuple(e.node for e in placed) if len(placed) <= FEW_NODES else (),
        advice=ADVICE if below and int8 else "",
    )
