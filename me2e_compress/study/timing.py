"""Latency of every model of a study, scaled to a device."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.latency import LatencySource
from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.measure import Measure, too_few
from me2e_compress.runtime.latency_trace import LatencyTrace, Load
from me2e_compress.runtime.profile import describe_machine, record_traces
from me2e_compress.study.condition import Condition
from me2e_compress.study.definition import Study, Variant
from me2e_compress.study.prepared import PreparedVariant
from me2e_compress.study.workspace import Workspace
from me2e_compress.workflows.result import Listener


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
    """Load the traces that are given or kept, and measure the others, interleaved.

    Models measured together share their noise. A kept trace must be of the same model,
    machine, threads and frames, with at least as many samples (studies in one folder
    share the longest); otherwise it is measured again. Files from before traces named
    their frames are assumed to match. Without a kept trace of the baseline, kept traces
    cannot be compared with new ones, so all are measured again.

    Raises:
        EvaluationError: A trace cannot be read or written, or the baseline's median,
            which sets the device scale, is zero.
    """
    frames = None if study.held_out is None else CalibrationSet(study.held_out)
    seen = None if frames is None else frames.fingerprint
    traces = dict[str, LatencyTrace]()
    for each in prepared:
        kept = _kept(study, each, seen, workspace, listener)
        if kept is not None:
            traces[each.variant.name] = kept
    if frames is None:
        why = "no held-out frames were given"
        return Clock(traces, _scale(study, traces), why, _load(prepared, traces))
    baseline = next(each for each in prepared if each.variant is study.reference)
    kept_baseline = None if baseline.variant.trace else traces.get(study.baseline)
    missing = _missing(prepared, traces, kept_baseline, workspace, listener)
    measured = _measured(study, frames, missing, baseline, kept_baseline, listener)
    # the baseline last: a kill before leaves none that old ones could stand beside
    for each in sorted(missing, key=lambda one: one is baseline):
        trace = replace(measured[each.variant.name], frames=seen)
        trace.save(workspace.trace(each.variant))
        traces[each.variant.name] = trace
    load = _load(prepared, traces)
    return Clock(traces, _scale(study, traces), "not a model", load)


def _load(
    prepared: Sequence[PreparedVariant], traces: Mapping[str, LatencyTrace]
) -> Load | None:
    """Return the highest load under which a trace was measured here."""
    names = [each.variant.name for each in prepared if not each.variant.trace]
    found = [traces[name].others for name in names if name in traces]
    known = [each for each in found if each is not None]
    return max(known, key=lambda load: load.others, default=None)


def _missing(
    prepared: Sequence[PreparedVariant],
    traces: Mapping[str, LatencyTrace],
    kept_baseline: LatencyTrace | None,
    workspace: Workspace,
    listener: Listener,
) -> list[PreparedVariant]:
    """List what is to be measured: all, if new traces cannot be compared with old."""
    ours = [each for each in prepared if each.model and not each.variant.trace]
    missing = [each for each in ours if each.variant.name not in traces]
    if kept_baseline is not None or not missing:
        return missing
    for each in ours:
        if each not in missing:
            path = workspace.trace(each.variant)
            listener.on_warning(
                f"{path}: no trace of the baseline is kept beside it: measured again"
            )
    return ours


def _measured(
    study: Study,
    frames: CalibrationSet,
    missing: Sequence[PreparedVariant],
    baseline: PreparedVariant,
    kept: LatencyTrace | None,
    listener: Listener,
) -> dict[str, LatencyTrace]:
    """Measure in turn, always with the baseline.

    If its trace is kept, the others are put on its scale: a machine's speed varies from
    day to day.
    """
    if not missing:
        return {}
    # the baseline is always measured with the others
    name = baseline.variant.name
    timed = missing if kept is None else (baseline, *missing)
    found = record_traces(
        {each.variant.name: each.model for each in timed if each.model is not None},
        frames,
        samples=study.timing.samples,
        threads=study.timing.threads,
        provider=study.provider,
        on_sample=partial(listener.on_progress, "latency"),
    )
    # put them on the scale of the kept baseline
    if kept is None:
        return found
    pace = kept.percentile_us(50) / max(1, found.pop(name).percentile_us(50))
    return {each: _paced(trace, pace) for each, trace in found.items()}


def _paced(trace: LatencyTrace, pace: float) -> LatencyTrace:
    samples_us = tuple(round(sample * pace) for sample in trace.samples_us)
    return replace(trace, samples_us=samples_us)


def _kept(
    study: Study,
    each: PreparedVariant,
    frames: str | None,
    workspace: Workspace,
    listener: Listener,
) -> LatencyTrace | None:
    if each.variant.trace is not None:
        return LatencyTrace.load(each.variant.trace)
    path = workspace.trace(each.variant)
    if each.model is None or not path.is_file():
        return None
    trace = LatencyTrace.load(path)
    other = _other(trace, each, frames, study)
    if other is None:
        return trace
    then = "left out" if study.held_out is None else "measured again"
    listener.on_warning(f"{path}: of {other}: {then}")
    return None


def _other(
    trace: LatencyTrace, each: PreparedVariant, frames: str | None, study: Study
) -> str | None:
    """Return what a trace measured if it was something else; else None."""
    wanted = study.timing.samples
    machine = describe_machine(study.timing.threads, study.provider)
    if trace.model_sha256 != each.sha256:
        return "another model"
    if len(trace.samples_us) < wanted:
        return f"{len(trace.samples_us)} samples, not {wanted}"
    # as it was written before 1 was singular
    if trace.machine.replace("on 1 threads", "on 1 thread") != machine:
        return f"another machine ({trace.machine}; this is {machine})"
    if None not in (trace.frames, frames) and trace.frames != frames:
        return "other frames"
    return None


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
