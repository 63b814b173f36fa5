"""What a compression did: what became int8, and what the outputs lost by it."""

import dataclasses
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Self

import onnx_ir as ir

from me2e_compress.base.display import Table, format_mb, plural
from me2e_compress.base.errors import EvaluationError, FramesError, GraphError
from me2e_compress.base.listener import Listener
from me2e_compress.calibration.dataset import CalibrationSet, hold_out, spread
from me2e_compress.commands.compare import compare_sessions, outputs_table
from me2e_compress.commands.runtime_loss import RuntimeLoss, has_int8_kernels
from me2e_compress.fidelity.compare import Fidelity, SetFidelity, SetTally, compare
from me2e_compress.fidelity.floor import Floor, Shortfall, format_figure
from me2e_compress.fidelity.liveness import Liveness
from me2e_compress.graph import WEIGHTED
from me2e_compress.graph.recurrence import recurrent_inputs
from me2e_compress.manager import Report
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8, Quantizer, quantizes_float
from me2e_compress.quantization.decision import FLOAT, QuantPlan, plan_of
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.latency_trace import cpu_seconds
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider
from me2e_compress.runtime.session import Session
from me2e_compress.shipped.drivers import frames_of
from me2e_compress.targets import TARGETS

LEAST_BYTES = 1024
"""Smaller constants are not worth a word."""

_FLOATS = (ir.DataType.FLOAT, ir.DataType.FLOAT16, ir.DataType.DOUBLE)


def float_bytes(model: ir.Model, plan: QuantPlan) -> dict[str, int]:
    """Return the bytes of weights that stay float by rule, the most first.

    Left out are weights that any node stores as int8, biases of int8 layers, and
    constants below a kilobyte. What the plan's target leaves in float is by ``target``.
    """
    decided = {each.output: each for each in plan.decisions}
    left_float = {each.output for each in plan.kept_float}
    # float weights, and those that some other node stores as int8
    left, stored = dict[str, tuple[str, int]](), set[str]()
    for node in model.graph:
        decision = decided.get(str(node.outputs[0].name)) if node.outputs else None
        if decision is None:
            continue
        is_int8 = decision.dtype != FLOAT and decision.output not in left_float
        for at, value in enumerate(node.inputs):
            if value is None or (tensor := value.const_value) is None:
                continue
            if tensor.dtype not in _FLOATS or tensor.nbytes < LEAST_BYTES:
                continue
            if is_int8 and at == decision.weight:
                stored.add(str(value.name))
            elif not is_int8:
                rule = "target" if decision.output in left_float else decision.rule
                left.setdefault(str(value.name), (rule, tensor.nbytes))
    by_rule = Counter[str]()
    for name, (rule, size) in left.items():
        by_rule[rule] += 0 if name in stored else size
    return {rule: size for rule, size in by_rule.most_common() if size}


LEAST_SHOWN = 10_000
"""Bytes of float weights from which on a rule is named."""
_SLOW_HERE = {
    "tensorrt": (
        "it is quantized in TensorRT's form, slow in onnxruntime's CPU: --target"
        " onnxruntime writes what is fast here"
    ),
    "openvino": (
        "it is quantized for OpenVINO, slow in onnxruntime's CPU: run it by --provider"
        " openvino"
    ),
}


@dataclasses.dataclass(frozen=True)
class Int8Outcome:
    """What the pass that quantizes achieved.

    Attributes:
        by: name of the pass.
        nodes: number of nodes that it made int8.
        layers: convolutions and matrix products; in all modules, None where
            the pass leaves no plan.
        kept: layers left float, by rule and reason; most first.
        float_bytes: weights that stayed float, by rule; most first.
        slow_here: that this CPU runs it slowly, and what is fast; None where it is not
            for TensorRT, or another provider runs it.
    """

    by: str
    nodes: int
    layers: int | None = None
    kept: Mapping[str, int] = dataclasses.field(default_factory=dict)
    float_bytes: Mapping[str, int] = dataclasses.field(default_factory=dict)
    slow_here: str | None = None

    @classmethod
    def of(cls, report: Report, context: Context) -> Self | None:
        """Read the outcome from a run of the manager; None where no pass quantizes."""
        quantizer = next((e for e in report.lossy if quantizes_float(e.applied)), None)
        if quantizer is None:
            return None
        name, changes = quantizer.applied.name, quantizer.changes
        # the plan that was carried out; if nothing changed, it is made again
        plan = plan_of(report.model) if changes else None
        if plan is None and isinstance(quantizer.applied, QuantizeInt8):
            plan = quantizer.applied.plan(quantizer.before, context)
        # without a plan only the number of changes is known
        if plan is None:
            return cls(name, changes)
        layers = [each for each in plan.decisions if each.op in WEIGHTED]
        placed = {each.output for each in plan.placed}
        left = [each for each in layers if each.output not in placed]
        why = {each.output: f"target: {each.reason}" for each in plan.kept_float}
        kept = Counter(why.get(e.output, f"{e.rule}: {e.reason}") for e in left)
        slow = changes and context.provider.native == CPU.native
        return cls(
            name,
            changes,
            len(layers),
            dict(kept.most_common()),
            float_bytes(quantizer.before, plan),
            _SLOW_HERE.get(plan.target) if slow else None,
        )

    @property
    def line(self) -> str:
        """How many nodes became int8, and which weights did not."""
        line = f"int8: {plural(self.nodes, 'node')}"
        if self.float_bytes:
            rules = ", ".join(
                f"{rule} {format_mb(count)}"
                for rule, count in self.float_bytes.items()
                if count >= LEAST_SHOWN
            )
            total = format_mb(sum(self.float_bytes.values()))
            line += f"; {total} MB of weights stay float"
            line += f", by rule: {rules}" if rules else ""
        return line

    @property
    def why_empty(self) -> str:
        """Why nothing became int8, with the two commonest rules; empty if some did."""
        if self.nodes:
            return ""
        # say what the layers are kept float by, the commonest rules first
        parts = [f"{self.by} made nothing int8"]
        if self.layers is not None:
            of = "(convolutions, matrix products) in the graph"
            parts.append(f"{plural(self.layers, 'layer')} {of}")
        most = list(self.kept.items())[:2]
        parts += [f"{count} by rule {why}" for why, count in most]
        return "; ".join(parts)


NOT_ASKED = "--measure-frames 0"
FEW_NODES = 3
"""So many int8 nodes are named where the loss is."""
FEW_FRAMES = 3
"""Fewer frames say little: four of one drive lay 12 to 15 dB from four others."""


@dataclasses.dataclass(frozen=True)
class MeasuredLoss:
    """How true a compressed model stayed, and where it did not.

    Attributes:
        fidelity: fidelity to the graph before the first lossy pass; None if not
            measured.
        on: which frames were used, or why nothing was measured, in words.
        incomparable: whether an output is not finite, or of another shape than before.
        shortfalls: outputs below the floor, the worst first.
        guilty: the lossy passes, which cause the shortfalls between them.
        int8_nodes: the nodes that are int8, where they are three at most.
        advice: the command that measures int8 module by module; empty where nothing is
            below the floor, or nothing is int8.
        liveness: which outputs still move; None if not asked.
        agents: outputs that are sets, by their matched agents; None without any.
        runtime: what onnxruntime's int8 answers otherwise; None if it is not for it.
        seconds: CPU time of measuring.
    """

    fidelity: Fidelity | None
    on: str
    floor: Floor
    liveness: Liveness | None = None
    runtime: RuntimeLoss | None = None
    agents: SetFidelity | None = None
    shortfalls: tuple[Shortfall, ...] = ()
    guilty: tuple[str, ...] = ()
    int8_nodes: tuple[str, ...] = ()
    advice: str = ""
    seconds: float = 0.0
    incomparable: bool = False

    def lines(self) -> Iterator[str]:
        """Yield how far the outputs moved, and which are alive or not judged."""
        fidelity = self.fidelity
        if fidelity is not None:
            parts = list[str]()
            if fidelity.plan is not None:
                parts.append(
                    f"the plan moves {fidelity.plan.mean_m:.3f} m on average,"
                    f" {fidelity.plan.max_m:.2f} m at most"
                )
            matched = {} if self.agents is None else self.agents.sqnr_db
            judged = [
                each
                for each in fidelity.outputs
                if each.name not in (fidelity.plan_output, *matched)
                and not each.discrete
            ]
            if judged:
                worst = min(judged, key=lambda each: each.sqnr_db)
                noise, reach = format_figure(worst.sqnr_db, "dB"), worst.by_frame
                every = fidelity.seen and f" of {fidelity.frames + fidelity.seen}"
                reach = f" ({reach} by frame{every or ''})" if reach else ""
                parts.append(f"the noisiest output is {worst.name}, {noise}{reach}")
            frames_text = f"on {plural(fidelity.frames, 'frame')} {self.on}"
            yield f"{'; '.join(parts) or 'no output could be judged'} ({frames_text})"
        elif self.on != NOT_ASKED:
            yield f"fidelity: not measured ({self.on})"
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
        if self.fidelity is not None and self.fidelity.frames < FEW_FRAMES:
            yield (
                f"this verdict rests on {plural(self.fidelity.frames, 'frame')}:"
                f" record {3 * FEW_FRAMES} or more, a third of which is measured on"
            )
        if self.fidelity is not None:
            yield from self.fidelity.stray_texts
        if self.shortfalls:
            low, guilty = ", ".join(map(str, self.shortfalls)), ", ".join(self.guilty)
            nodes = f" ({', '.join(self.int8_nodes)})" if self.int8_nodes else ""
            yield f"below the floor ({self.floor}): {low}; lost in {guilty}{nodes}"
        if self.advice:
            yield f"{self.advice} measures which modules lose it"

    def table(self) -> Table | None:
        """Return the SQNR and largest error of every output; None if not measured."""
        fidelity = self.fidelity
        if fidelity is None:
            return None
        below = {each.output for each in self.shortfalls}
        verdicts = {
            each.name: "not judged: whole numbers"
            for each in fidelity.outputs
            if each.discrete
        }
        verdicts |= dict.fromkeys(below, "below")
        title = f"Fidelity on {plural(fidelity.frames, 'frame')} {self.on}"
        return outputs_table(title, fidelity, self.agents, verdicts)

    def record(self) -> dict[str, object]:
        """Return what the report says of it: all but the time."""
        names = (each.name for each in dataclasses.fields(self))
        return {name: getattr(self, name) for name in names if name != "seconds"}


RUN_FRAMES = 4
"""Frames measured in a row of a model that has a state."""
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
        seen: as many of those calibrated on at most.
        samples: frames that exact passes are checked on where the user gave none.
    """

    calibration: CalibrationSet | None
    measured: Frames | None
    kind: str
    samples: CalibrationSet | None = None
    seen: CalibrationSet | None = None


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
    elif (shipped := frames_of(source)) is not None:
        samples = CalibrationSet(shipped)
    if not most or all(each.exact for each in passes):
        return SplitFrames(recording, None, NOT_ASKED, samples)
    if recording is None:
        reason = "no recorded frames" if samples is None else SHIPPED_FRAMES
        return SplitFrames(None, samples, reason, samples)
    run = RUN_FRAMES if recurrent_inputs(model) else 1
    calibration, measured = hold_out(recording, most, run)
    if any(isinstance(each, Quantizer) and not each.needs_frames for each in passes):
        return SplitFrames(recording, measured, PERHAPS_SHARED)
    if len(recording) == 1:
        return SplitFrames(calibration, measured, SHARED)
    seen = spread(calibration, most, run)
    return SplitFrames(calibration, measured, KEPT_OUT, seen=seen)


def measure_loss(
    report: Report,
    provider: Provider,
    frames: SplitFrames,
    floor: Floor,
    listener: Listener,
) -> MeasuredLoss | None:
    """Compare with the graph before the first lossy pass; None if all are exact."""
    if not report.lossy:
        return None
    loss = MeasuredLoss(None, frames.kind, floor)
    if frames.measured is None:
        return loss
    start = cpu_seconds()
    listener.on_progress("fidelity", 0, 1, "")
    # a graph that does not run or compare is a finding, not a failure
    try:
        loss = _compare(loss, report, provider, frames.measured, frames.seen)
    except (FramesError, GraphError) as error:
        loss = dataclasses.replace(loss, on=str(error))
    except EvaluationError as error:  # not finite, or of another shape
        loss = dataclasses.replace(loss, on=str(error), incomparable=True)
    return dataclasses.replace(loss, seconds=cpu_seconds() - start)


def runner_of(passes: Iterable[Pass], provider: Provider) -> Provider | None:
    """Return what runs the int8 that passes wrote; None where it is not here."""
    names = [
        "cpu" if isinstance(each, LowerInt8) else TARGETS.parse(each.target).runs_in
        for each in passes
        if isinstance(each, LowerInt8 | QuantizeInt8)
    ]
    if not names or not names[-1]:
        return None
    runner = PROVIDERS.parse(names[-1])
    if runner.native == CPU.native:
        return provider
    return runner if runner.is_installed() else None


def _compare(
    loss: MeasuredLoss,
    report: Report,
    provider: Provider,
    frames: Frames,
    seen: Frames | None,
) -> MeasuredLoss:
    """Return the loss with fidelity, liveness and the outputs below the floor."""
    passes = [each.applied for each in report.lossy]
    before, after = report.lossy[0].before, report.model
    open_session = partial(Session, release=True, provider=provider)
    reference, session = open_session(before), open_session(after)
    # a graph is run by the int8 kernels of the runtime that it was written for, too
    kernels = None
    runner = runner_of(passes, provider)
    if runner is not None and has_int8_kernels(after, runner):
        kernels = Session(after, release=True, stock=True, provider=runner)
    sets = SetTally.of(reference, session)
    comparison = compare_sessions(reference, session, frames, after, kernels, sets)
    if seen is not None:
        beside = comparison.fidelity.widen(compare(reference, session, seen))
        comparison = dataclasses.replace(comparison, fidelity=beside)
    loss = dataclasses.replace(loss, **vars(comparison))
    below = loss.floor.shortfalls(comparison.fidelity, comparison.agents)
    if not below:
        return loss
    int8 = any(isinstance(each, QuantizeInt8) for each in passes)
    plan = plan_of(after) if int8 else None
    placed = () if plan is None else plan.placed
    return dataclasses.replace(
        loss,
        shortfalls=below,
        guilty=tuple(each.name for each in passes),
        int8_nodes=tuple(e.node for e in placed) if len(placed) <= FEW_NODES else (),
        advice=ADVICE if int8 else "",
    )
