"""What a study knows of a variant without its drives: latency, size, plan.

Latencies are traces: recorded on a device, or measured here in turn.
"""

import hashlib
import math
import os
import platform
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.latency import LatencySource
from me2e_compress.errors import EvaluationError, FramesError
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
from me2e_compress.workflows.result import Listener

LATENCY_PERCENTILES = (50, 99)


@dataclass(frozen=True)
class Clock:
    """Latencies of the variants on one device.

    Attributes:
        traces: As measured, by the variant's name.
        scale: How many times slower the device is than the machine of the traces.
        reason: Why a variant has no trace; empty if all have one.
        load: The highest load by other processes during measurements, if there were
            any.
    """

    traces: Mapping[str, LatencyTrace]
    scale: float
    reason: str = ""
    load: Load | None = None

    def latencies(self, prepared: PreparedVariant) -> dict[int, Measure]:
        """Return the percentiles that are shown; none of no model."""
        if prepared.model is None:
            unknown = Measure(None, "ms", prepared.failure or "no model")
            return dict.fromkeys(LATENCY_PERCENTILES, unknown)
        name = prepared.variant.name
        return {each: self.latency(name, each) for each in LATENCY_PERCENTILES}

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
    traces = {
        each.variant.name: LatencyTrace.load(each.variant.trace)
        for each in prepared
        if each.variant.trace is not None
    }
    measured = dict[str, LatencyTrace]()
    reason = "no held-out frames were given"
    if study.held_out is not None:
        reason = "not a model"
        timed = [each for each in prepared if each.model and not each.variant.trace]
        frames = CalibrationSet(study.held_out)
        measured = _measured(study, frames, timed, workspace, listener)
    # the highest load under which a trace was measured here
    known = [each.others for each in measured.values() if each.others is not None]
    load = max(known, key=lambda load: load.others, default=None)
    traces |= measured
    return Clock(traces, _scale(study, traces), reason, load)


def _measured(
    study: Study,
    frames: CalibrationSet,
    timed: Sequence[PreparedVariant],
    workspace: Workspace,
    listener: Listener,
) -> dict[str, LatencyTrace]:
    """Measure models in turn, or load what was measured together before.

    Models measured together share their noise, and a machine's speed varies from day to
    day: traces are kept as a set, of the same models, machine, samples and frames.
    """
    timing = study.timing
    machine = in_turn_text(timing.threads, study.provider)
    parts = machine, str(timing.samples), frames.fingerprint
    digests = (f"{each.variant.name} {each.sha256}" for each in timed)
    key = hashlib.sha256("\n".join((*parts, *digests)).encode()).hexdigest()
    paths = {each.variant.name: workspace.trace(each.variant, key) for each in timed}
    if all(path.is_file() for path in paths.values()):
        return {name: LatencyTrace.load(path) for name, path in paths.items()}
    traces = record_traces(
        {each.variant.name: each.model for each in timed if each.model is not None},
        frames,
        metadata={each.variant.name: each.metadata for each in timed},
        samples=timing.samples,
        threads=timing.threads,
        provider=study.provider,
        on_sample=partial(listener.on_progress, "latency"),
    )
    # a kill between leaves no whole set: all are measured again
    for name, path in paths.items():
        traces[name] = replace(traces[name], frames=frames.fingerprint)
        traces[name].save(path)
    return traces


def _scale(study: Study, traces: Mapping[str, LatencyTrace]) -> float:
    """Choose the one scale that gives the baseline the requested median."""
    wanted_s = study.timing.baseline_median_s
    if wanted_s is None:
        return 1.0
    if study.baseline not in traces:
        raise EvaluationError(
            f"latency: the device scale needs a median of {wanted_s} s of "
            f"{study.baseline}, and there is no trace of it"
        )
    median_us = traces[study.baseline].percentile_us(50)
    if not median_us:
        raise EvaluationError(
            f"latency: {study.baseline} has a median of 0 us: no scale makes it "
            f"{wanted_s} s"
        )
    return 1e6 * wanted_s / median_us


def judge(
    study: Study,
    baseline: PreparedVariant,
    prepared: PreparedVariant,
    listener: Listener,
) -> PlanFidelity:
    """Run both models over the held-out frames, and compare their plans.

    A model with another interface is not an error: the result has a reason instead.
    """
    # reasons why there is nothing to compare
    if study.held_out is None:
        return PlanFidelity.unknown("no held-out frames were given")
    if prepared.model is None or baseline.model is None:
        lacks = prepared if prepared.model is None else baseline
        why = prepared.failure or f"{lacks.variant.name} is not a model"
        return PlanFidelity.unknown(why)
    if prepared is baseline:
        return PlanFidelity.unknown("the baseline itself")
    # both models over all held-out frames
    recording = CalibrationSet(study.held_out)
    stage = f"fidelity of {prepared.variant.name}"
    left, right = (
        Session(path, provider=study.provider, metadata=metadata)
        for path, metadata in (
            (baseline.model, baseline.metadata),
            (prepared.model, prepared.metadata),
        )
    )

    def reported() -> Iterator[Frame]:
        for frame in recording:
            listener.on_progress(stage, frame.index, len(recording), "frames")
            yield frame

    try:
        fidelity = compare(left, right, reported())
    except (EvaluationError, FramesError) as error:
        return PlanFidelity.unknown(str(error))
    if fidelity.plan is None:
        return PlanFidelity.unknown(fidelity.plan_reason)
    if not math.isfinite(fidelity.plan.max_m):
        return PlanFidelity.unknown("its plan is not finite")
    # an identical plan has an infinite ratio
    noise = {each.name: each.sqnr_db for each in fidelity.outputs}[fidelity.plan_output]
    sqnr = Measure(None, "dB", EXACT if noise == math.inf else "no plan")
    if math.isfinite(noise):
        sqnr = Measure(noise, "dB")
    mean_m, max_m = fidelity.plan.mean_m, fidelity.plan.max_m
    metres = Measure(mean_m, "m"), Measure(max_m, "m")
    return PlanFidelity(*metres, sqnr, fidelity.frames)


def this_machine(load: Load | None = None) -> str:
    """Name processor, cores and system, and a load that makes latencies doubtful."""
    cores = f"{os.cpu_count() or 1} cores"
    named = f"{processor()}, {cores}, {platform.system()} {platform.machine()}"
    return f"{named}; {load}" if load is not None and load.busy else named
