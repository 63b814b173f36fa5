"""Measure what lossy passes did to a model, on frames kept out of calibration."""

import dataclasses
from collections.abc import Sequence
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import hold_out
from me2e_compress.calibration.stack_frames import recording_of
from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import EvaluationError, FramesError, GraphError, Me2eError
from me2e_compress.fidelity.compare import Fidelity, Reference
from me2e_compress.fidelity.floor import Floor, Rounding
from me2e_compress.fidelity.liveness import LivenessTally
from me2e_compress.graph import LoadedModel
from me2e_compress.manager import Report
from me2e_compress.manager.report import LossyPass
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import QuantPlan, plan_of
from me2e_compress.quantization.plan.overrides import Override, overrides_text
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.others_load import cpu_seconds
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session
from me2e_compress.sensitivity.estimate import estimate
from me2e_compress.sensitivity.remedy import MOST_TRIALS, RemedySearch
from me2e_compress.targets import TARGETS
from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.measured_loss import NOT_ASKED, MeasuredLoss
from me2e_compress.workflows.runtime_loss import RuntimeTally, has_int8_kernels
from me2e_compress.zoo.shipped import sample_frames

KEPT_OUT = "kept out of calibration"
SHARED = "calibrated on as well: there is no other"
PERHAPS_SHARED = "that the saved ranges may have been measured on"
SHIPPED_FRAMES = "that ship with the model"


def open_frames(
    loaded: LoadedModel, folder: str | Path | None, provider: Provider
) -> tuple[CalibrationSet | None, CalibrationSet | None]:
    """Open and check the recording, or the frames that ship with the model."""
    if folder is not None:
        return recording_of(loaded, folder, provider), None
    shipped = sample_frames(loaded.path)
    return None, None if shipped is None else CalibrationSet(shipped)


@dataclasses.dataclass(frozen=True)
class SplitFrames:
    """Frames that passes see, and those that the result is measured on.

    Attributes:
        kind: what kind the measured frames are, or why there are none, in words.
        samples: frames that exact passes are checked on where the user gave none.
    """

    calibration: Recording | None
    measured: Frames | None
    kind: str
    samples: CalibrationSet | None = None

    @classmethod
    def of(
        cls,
        recording: CalibrationSet | None,
        samples: CalibrationSet | None,
        passes: Sequence[Pass],
        most: int,
    ) -> "SplitFrames":
        """Keep up to `most` frames to measure on, where a pass is lossy.

        Nothing is kept out of calibration where ranges are saved.
        """
        if not most or all(each.exact for each in passes):
            return cls(recording, None, NOT_ASKED, samples)
        if recording is None:
            reason = "no recorded frames" if samples is None else SHIPPED_FRAMES
            return cls(None, samples, reason, samples)
        calibration, measured = hold_out(recording, most)
        if any(each.reads_ranges and not each.needs_frames for each in passes):
            return cls(recording, measured, PERHAPS_SHARED)
        return cls(calibration, measured, SHARED if len(recording) == 1 else KEPT_OUT)


def measure_loss(
    report: Report,
    context: Context,
    frames: SplitFrames,
    floor: Floor,
    listener: Listener,
    search: bool = True,
) -> MeasuredLoss | None:
    """Compare the graph with that before the first lossy pass; None if all are exact.

    Below the floor, the outputs that choose between near-equal candidates are set
    aside, and, with ``search``, the nodes of the int8 plan that cause the loss found.
    """
    if not report.lossy:
        return None
    if frames.measured is None:
        return MeasuredLoss(None, frames.kind, floor)
    start = cpu_seconds()
    listener.on_progress("fidelity", 0, 1, "")
    # a graph that does not run or compare is a finding, not a failure
    measurement = _Measurement(
        report, context, frames.measured, floor, listener, search
    )
    found = MeasuredLoss(None, frames.kind, floor)
    try:
        found = measurement.judge(found)
    except (FramesError, GraphError) as error:
        found = dataclasses.replace(found, on=str(error))
    except EvaluationError as error:  # not finite, or of another shape
        found = dataclasses.replace(found, on=str(error), incomparable=True)
    return dataclasses.replace(found, seconds=cpu_seconds() - start)


@dataclasses.dataclass(frozen=True)
class _Measurement:
    report: Report
    context: Context
    frames: Frames
    floor: Floor
    listener: Listener
    search: bool

    def judge(self, found: MeasuredLoss) -> MeasuredLoss:
        """Measure; below the floor, find out which outputs, passes and nodes."""
        before = self.report.lossy[0].before
        reference = self._reference(self.report.lossy[0])
        found = self._answers(found, reference)
        fidelity = found.fidelity
        assert fidelity is not None
        low = [each.output for each in self.floor.shortfalls(fidelity)]
        if not low:
            return found
        # outputs that choose between near-equal candidates are not judged
        rounding = Rounding.of(reference, before, self.floor).among(low)
        unsteady = {name: rounding.values[name] for name in rounding.choices}
        below = self.floor.shortfalls(fidelity, unsteady)
        found = dataclasses.replace(
            found, unsteady=unsteady, rounding=rounding, shortfalls=below
        )
        return self._blame(found, reference) if below else found

    def _answers(self, found: MeasuredLoss, reference: Reference) -> MeasuredLoss:
        """Compare the result with the graph before, and how both answer their inputs.

        What lossy passes other than a quantizer cut, they are meant to cut. A graph for
        onnxruntime is run by its int8 kernels, too.
        """
        session, model = self._session(self.report.model), self.report.model
        alive = self.floor.alive
        lively = LivenessTally(reference.session, session) if alive else None
        kernels = self._kernels(model)

        def watch(a: dict[str, Array], b: dict[str, Array], frame: Frame) -> None:
            for tally in (lively, kernels):
                if tally is not None:
                    tally.add(a, b, frame)

        fidelity = reference.compare(session, watch=watch)
        ablated = not all(each.applied.quantizes for each in self.report.lossy)
        return dataclasses.replace(
            found,
            fidelity=fidelity,
            liveness=None
            if lively is None
            else lively.result(alive, model, ablated=ablated),
            runtime=None if kernels is None else kernels.result(model, fidelity),
        )

    def _kernels(self, model: ir.Model) -> RuntimeTally | None:
        """Return what runs a graph that was written for onnxruntime as it runs it."""
        provider = self.context.provider
        written = False
        for lossy in self.report.lossy:
            current = lossy.applied
            written |= isinstance(current, LowerInt8)
            if isinstance(current, QuantizeInt8):
                written |= TARGETS.parse(current.target).opens
        if not written or not has_int8_kernels(model, provider):
            return None
        session = Session(model, stock=True, release=True, provider=provider)
        return RuntimeTally(session, self.frames)

    def _blame(self, found: MeasuredLoss, reference: Reference) -> MeasuredLoss:
        """Name the passes, and where int8 is to blame, the nodes."""
        lossy = self.report.lossy
        names = tuple(each.applied.name for each in lossy)
        # without a quantizer all lossy passes share the blame
        quantizer = next((each for each in lossy if each.applied.quantizes), None)
        if quantizer is None:
            return dataclasses.replace(found, guilty=names)
        assert found.fidelity is not None
        added = found.fidelity
        if quantizer is not lossy[0]:  # it is judged by what it adds to the others
            reference = self._reference(quantizer)
            added = reference.compare(self._session(self.report.model))
            if not self.floor.shortfalls(added, found.unsteady):
                others = tuple(each for each in names if each != quantizer.applied.name)
                return dataclasses.replace(found, guilty=others)
        guilty = dataclasses.replace(found, guilty=(quantizer.applied.name,))
        applied, plan = quantizer.applied, plan_of(self.report.model)
        # only what the toolkit's own pass decides can be varied node by node
        if not self.search or plan is None or not isinstance(applied, QuantizeInt8):
            return guilty
        begun = cpu_seconds()
        try:
            search = self._search(quantizer, applied, plan, reference, guilty)
            remedy = search.run(added)
        except Me2eError:  # a variant that cannot be made or compared ends the search
            remedy = None
        seconds = cpu_seconds() - begun
        return dataclasses.replace(guilty, remedy=remedy, search_seconds=seconds)

    def _search(
        self,
        quantizer: LossyPass,
        applied: QuantizeInt8,
        plan: QuantPlan,
        reference: Reference,
        found: MeasuredLoss,
    ) -> RemedySearch:
        """Estimate what each int8 node costs the outputs that are below the floor."""
        before, target = quantizer.before, TARGETS.parse(applied.target)
        ranges = self.context.ranges(
            applied.name,
            before,
            target.tensors(plan, before),
            method=applied.method_of_ranges,
            saved=applied.ranges,
        )
        progress = partial(self.listener.on_progress, "search")
        progress(0, MOST_TRIALS, "the nodes that lose it (--no-remedy: none)")
        # as many outputs as frames, so that it takes three inferences a frame
        low = [each.output for each in found.shortfalls][: len(reference.frames)]
        costs = estimate(
            before,
            plan,
            target.grids(plan, before, ranges),
            reference.frames,
            outputs=low,
            seed=self.context.seed,
            provider=self.context.provider,
        )

        def measure(more: Sequence[Override]) -> Fidelity:
            varied = self._with_overrides(quantizer, more)
            return reference.compare(self._session(varied))

        return RemedySearch(costs, low, measure, self.floor, found.unsteady, progress)

    def _with_overrides(
        self, quantizer: LossyPass, more: Sequence[Override]
    ) -> ir.Model:
        """Run the pass that quantized again; what the user decided still holds."""
        asked = getattr(quantizer.applied, "overrides", None)
        text = "" if asked is None else Path(asked).read_text(encoding="utf-8")
        with TemporaryDirectory(prefix="me2e-trial-") as folder:
            path = Path(folder) / "overrides.toml"
            path.write_text(f"{text}\n{overrides_text(more)}", encoding="utf-8")
            again = quantizer.applied.with_options({"overrides": path})
            return again.run(quantizer.before.clone(), self.context).model

    def _reference(self, first: LossyPass) -> Reference:
        return Reference.of(self._session(first.before), self.frames)

    def _session(self, model: ir.Model) -> Session:
        return Session(model, release=True, provider=self.context.provider)
