"""Results of a variant without its drives: latency, size, plan.

Latencies are traces: recorded on a device, or measured here in turn.
"""

import hashlib
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path

from me2e_compress.base.errors import EvaluationError, FramesError
from me2e_compress.base.listener import Listener
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.latency import LatencySource
from me2e_compress.fidelity.compare import compare
from me2e_compress.metrics.measure import Measure, too_few
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.latency_trace import LatencyTrace, Load
from me2e_compress.runtime.profile import in_turn_text, processor, record_traces
from me2e_compress.runtime.session import Session
from me2e_compress.study.cells import EXACT
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Variant
from me2e_compress.study.prepared import PlanFidelity, PreparedVariant
from me2e_compress.study.workspace import Workspace

LATENCY_PERCENTILES = (50, 99)


@dataclass(frozen=True)
class Clock:
    """Latencies of the variants on one device."""

    traces: Mapping[str, LatencyTrace]  # as measured, by the variant's name
    scale: float  # how many times slower the device is than the machine of the traces
    reason: str = ""  # why a variant has no trace; empty if all have one
    # The highest load by other processes during measurements, if there were any
    load: Load | None = None

    def latencies(self, prepared: PreparedVariant) -> dict[int, Measure]:
        """Return percentiles of a variant in ms; without a model, the reason."""
        if prepared.model is None:
            unknown = Measure(None, "ms", prepared.failure or "no model")
            return dict.fromkeys(LATENCY_PERCENTILES, unknown)
        return {p: self.latency(prepared.name, p) for p in LATENCY_PERCENTILES}

    def latency(self, variant: str, percent: float) -> Measure:
        """Return a percentile on the device, ms; None without enough samples."""
        if variant not in self.traces:
            return Measure(None, "ms", self.reason or "not measured")
        trace = self.traces[variant]
        if why := too_few(percent, len(trace.samples_us)):
            return Measure(None, "ms", why)
        return Measure(self.scale * trace.percentile_us(percent) / 1e3, "ms")

    def source(
        self, variant: Variant, condition: Condition, seed: int
    ) -> LatencySource | None:
        """Return the latency source of a variant; None if it lacks its trace."""
        source = condition.source(seed)
        if not source.lacks_trace:
            return source
        if variant.name not in self.traces:
            return None
        return source.with_trace(self.traces[variant.name].samples_us, self.scale)


def time_all(
    study: Study,
    prepared: Sequence[PreparedVariant],
    workspace: Workspace,
    listener: Listener,
) -> Clock:
    """Load the traces that are given, and measure the others, interleaved.

    Raises:
        EvaluationError: A trace cannot be read or written, or the baseline's median,
            which sets the device scale, is zero.
    """
    traces, measured = dict[str, LatencyTrace](), dict[str, LatencyTrace]()
    for entry in prepared:
        if entry.variant.trace is not None:
            traces[entry.name] = LatencyTrace.load(entry.variant.trace)
    # Measure those without a trace
    reason = "no held-out frames were given"
    if study.held_out is not None:
        reason = "not a model"
        timed = [entry for entry in prepared if entry.model and not entry.variant.trace]
        measured = _measure_traces(study, study.held_out, timed, workspace, listener)
    # Find the highest load under which a trace was measured here
    loads = [trace.others for trace in measured.values() if trace.others is not None]
    load = max(loads, key=lambda load: load.others, default=None)
    traces |= measured
    # One scale for all gives the baseline the median that the study asks for
    median_s, baseline, scale = study.timing.baseline_median_s, study.baseline, 1.0
    if median_s is not None:
        if baseline not in traces:
            raise EvaluationError(
                f"latency: the device scale needs a median of {median_s} s of"
                f" {baseline}, and there is no trace of it"
            )
        measured_us = traces[baseline].percentile_us(50)
        if not measured_us:
            words = f"latency: {baseline} has a median of 0 us: no scale makes it"
            raise EvaluationError(f"{words} {median_s} s")
        scale = 1e6 * median_s / measured_us
    return Clock(traces, scale, reason, load)


def _measure_traces(
    study: Study,
    held_out: Path,
    timed: Sequence[PreparedVariant],
    workspace: Workspace,
    listener: Listener,
) -> dict[str, LatencyTrace]:
    """Measure models in turn, or load the traces that were measured together before.

    Models measured together share their noise: traces are stored as a set.
    """
    # Load the set if it is complete
    timing, frames = study.timing, CalibrationSet(held_out)
    machine = in_turn_text(timing.threads, study.provider)
    parts = machine, str(timing.samples), frames.fingerprint
    digests = (f"{entry.name} {entry.sha256}" for entry in timed)
    key = hashlib.sha256("\n".join((*parts, *digests)).encode()).hexdigest()
    paths = {entry.name: workspace.trace(entry.variant, key) for entry in timed}
    if all(path.is_file() for path in paths.values()):
        return {name: LatencyTrace.load(path) for name, path in paths.items()}
    traces = record_traces(
        {entry.name: entry.model for entry in timed if entry.model is not None},
        frames,
        metadata={entry.name: entry.metadata for entry in timed},
        samples=timing.samples,
        threads=timing.threads,
        provider=study.provider,
        on_sample=partial(listener.on_progress, "latency"),
    )
    # A kill while they are written leaves no complete set: all are measured again
    for name, path in paths.items():
        traces[name] = replace(traces[name], frames=frames.fingerprint)
        traces[name].save(path)
    return traces


def compare_plans(
    study: Study,
    baseline: PreparedVariant,
    prepared: PreparedVariant,
    listener: Listener,
) -> PlanFidelity:
    """Compare the plans of both models on the held-out frames, or say why not."""
    # Reasons why there is nothing to compare
    if study.held_out is None:
        return PlanFidelity.unknown("no held-out frames were given")
    if prepared.model is None or baseline.model is None:
        lacking = prepared if prepared.model is None else baseline
        return PlanFidelity.unknown(
            prepared.failure or f"{lacking.name} is not a model"
        )
    if prepared is baseline:
        return PlanFidelity.unknown("the baseline itself")
    # Run both models over the held-out frames
    recording, provider = CalibrationSet(study.held_out), study.provider
    left = Session(baseline.model, provider=provider, metadata=baseline.metadata)
    right = Session(prepared.model, provider=provider, metadata=prepared.metadata)

    def reported() -> Iterator[Frame]:
        stage, total = f"fidelity of {prepared.name}", len(recording)
        for frame in recording:
            listener.on_progress(stage, frame.index, total, "frames")
            yield frame

    try:
        fidelity = compare(left, right, reported())
    except (EvaluationError, FramesError) as error:
        return PlanFidelity.unknown(str(error))
    if fidelity.plan is None:
        return PlanFidelity.unknown(fidelity.plan_reason)
    plan, output = fidelity.plan, fidelity.plan_output
    if not math.isfinite(plan.max_m):
        return PlanFidelity.unknown("its plan is not finite")
    # An identical plan has an infinite ratio
    noise_db = next(drift.sqnr_db for drift in fidelity.outputs if drift.name == output)
    sqnr = Measure(None, "dB", EXACT if noise_db == math.inf else "no plan")
    if math.isfinite(noise_db):
        sqnr = Measure(noise_db, "dB")
    mean, largest = Measure(plan.mean_m, "m"), Measure(plan.max_m, "m")
    return PlanFidelity(mean, largest, sqnr, fidelity.frames)


def this_machine(load: Load | None = None) -> str:
    """Name processor, cores and system, and a load that makes latencies doubtful."""
    cores = f"{os.cpu_count() or 1} cores"
    named = f"{processor()}, {cores}, {platform.system()} {platform.machine()}"
    return f"{named}; {load}" if load is not None and load.busy else named
