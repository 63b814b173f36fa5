"""Measure what lossy passes did to a model, on frames kept out of calibration."""

import dataclasses
from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import hold_out
from me2e_compress.calibration.stream import Recording
from me2e_compress.errors import EvaluationError, FramesError, GraphError
from me2e_compress.fidelity.compare import Reference
from me2e_compress.fidelity.floor import Floor, Rounding
from me2e_compress.fidelity.liveness import LivenessTally
from me2e_compress.manager import Report
from me2e_compress.passes import Pass
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.frames import Array, Frame, Frames
from me2e_compress.runtime.latency_trace import cpu_seconds
from me2e_compress.runtime.providers import Provider
from me2e_compress.runtime.session import Session
from me2e_compress.shipped.drivers import sample_frames
from me2e_compress.targets import TARGETS
from me2e_compress.workflows.listener import Listener
from me2e_compress.workflows.measured_loss import NOT_ASKED, MeasuredLoss
from me2e_compress.workflows.runtime_loss import RuntimeTally, has_int8_kernels

KEPT_OUT = "kept out of calibration"
SHARED = "calibrated on as well: there is no other"
PERHAPS_SHARED = "that the saved ranges may have been measured on"
SHIPPED_FRAMES = "that ship with the model"
ADVICE = "me2e-compress sensitivity MODEL FRAMES -o RECIPE.toml"


def open_frames(
    source: Path, model: ir.Model, folder: str | Path | None
) -> tuple[CalibrationSet | None, CalibrationSet | None]:
    """Open and check the recording, or the frames that ship with the model."""
    if folder is not None:
        recording = CalibrationSet(folder)
        recording.check(model)
        return recording, None
    shipped = sample_frames(source)
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
    if frames.measured is None:
        return MeasuredLoss(None, frames.kind, floor)
    start = cpu_seconds()
    listener.on_progress("fidelity", 0, 1, "")
    # a graph that does not run or compare is a finding, not a failure
    measurement = _Measurement(report, provider, frames.measured, floor)
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
    provider: Provider
    frames: Frames
    floor: Floor

    def judge(self, found: MeasuredLoss) -> MeasuredLoss:
        """Measure; of what is below the floor, tell which outputs are judged."""
        before = self.report.lossy[0].before
        reference = Reference.of(self._session(before), self.frames)
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
        if not below:
            return found
        passes = [each.applied for each in self.report.lossy]
        int8 = any(isinstance(each, QuantizeInt8) for each in passes)
        return dataclasses.replace(
            found,
            guilty=tuple(each.name for each in passes),
            advice=ADVICE if int8 else "",
        )

    def _answers(self, found: MeasuredLoss, reference: Reference) -> MeasuredLoss:
        """Compare the result with the graph before, and how far the outputs move.

        A graph for onnxruntime is run by its int8 kernels, too.
        """
        session, model = self._session(self.report.model), self.report.model
        lively = LivenessTally(reference.session, session)
        kernels = self._kernels(model)

        def watch(a: dict[str, Array], b: dict[str, Array], frame: Frame) -> None:
            lively.add(a, b, frame)
            if kernels is not None:
                kernels.add(a, b, frame)

        fidelity = reference.compare(session, watch=watch)
        return dataclasses.replace(
            found,
            fidelity=fidelity,
            liveness=lively.result(),
            runtime=None if kernels is None else kernels.result(model, fidelity),
        )

    def _kernels(self, model: ir.Model) -> RuntimeTally | None:
        """Return what runs a graph that was written for onnxruntime as it runs it."""
        written = False
        for lossy in self.report.lossy:
            current = lossy.applied
            written |= isinstance(current, LowerInt8)
            if isinstance(current, QuantizeInt8):
                written |= TARGETS.parse(current.target).opens
        if not written or not has_int8_kernels(model, self.provider):
            return None
        session = Session(model, stock=True, release=True, provider=self.provider)
        return RuntimeTally(session, self.frames)

    def _session(self, model: ir.Model) -> Session:
        return Session(model, release=True, provider=self.provider)
