"""Latency of every model of a study, and the device that it stands for."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.latency import (
    LatencySource,
    TraceLatency,
    parse_latency,
)
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.race import traces_in_turn
from me2e_compress.study.definition import Condition, Scheme, Study
from me2e_compress.study.models import Contender
from me2e_compress.study.workplace import Listener, Workplace


@dataclass(frozen=True)
class Clock:
    """Latencies of the schemes on one device.

    Attributes:
        traces: As measured, by the scheme's name.
        scale: How many times slower the device is than the machine of the traces;
            one number for all schemes.
        reason: Why a scheme has no trace, in words; empty if all have one.
    """

    traces: Mapping[str, LatencyTrace]
    scale: float
    reason: str = ""

    def milliseconds(self, scheme: str, percent: float) -> float | None:
        """Return a percentile on the device; None without a trace."""
        if scheme not in self.traces:
            return None
        return self.scale * self.traces[scheme].percentile_us(percent) / 1e3

    def source(
        self, scheme: Scheme, condition: Condition, seed: int
    ) -> LatencySource | None:
        """Return what a scheme's decisions cost; None without the trace for it."""
        if not condition.traced:
            return parse_latency(condition.latency)
        if scheme.name not in self.traces:
            return None
        samples = self.traces[scheme.name].samples_us
        return TraceLatency(samples, scale=self.scale, seed=seed)


def time_all(
    study: Study,
    contenders: Sequence[Contender],
    workplace: Workplace,
    listener: Listener,
) -> Clock:
    """Take the traces that are given or kept, and measure the others in turn.

    What is measured together shares its noise. A trace that is kept is of the same
    model and has as many samples; one that is not is measured again.

    Raises:
        EvaluationError: A trace cannot be read or written, or the baseline's median,
            which sets the device scale, is zero.
    """
    traces = dict[str, LatencyTrace]()
    missing = list[Contender]()
    for each in contenders:
        kept = _kept(study, each, workplace, listener)
        if kept is not None:
            traces[each.scheme.name] = kept
        elif each.model is not None:
            missing.append(each)
    if study.held_out is None:
        return Clock(traces, _scale(study, traces), "no held-out frames were given")
    baseline = next(each for each in contenders if each.scheme is study.reference)
    yardstick = None if baseline.scheme.trace else traces.get(study.baseline)
    measured = _measured(study, missing, baseline, yardstick, listener)
    for each in missing:
        name = each.scheme.name
        measured[name].save(workplace.trace(each.scheme))
        traces[name] = measured[name]
    return Clock(traces, _scale(study, traces), "not a model")


def _measured(
    study: Study,
    missing: Sequence[Contender],
    baseline: Contender,
    kept: LatencyTrace | None,
    listener: Listener,
) -> dict[str, LatencyTrace]:
    """Measure in turn, beside the baseline: it is the yardstick of another day.

    Where the baseline's trace is kept, the others are put on its scale: machines are
    slower on some days than on others.
    """
    if study.held_out is None or not missing:
        return {}
    name = baseline.scheme.name
    timed = missing if kept is None else (baseline, *missing)
    found = traces_in_turn(
        {each.scheme.name: each.model for each in timed if each.model is not None},
        CalibrationSet(study.held_out),
        samples=study.timing.samples,
        threads=study.timing.threads,
        on_sample=lambda done, total, words: listener.on_progress(
            "latency", done, total, words
        ),
    )
    if kept is None:
        return found
    pace = kept.percentile_us(50) / max(1, found.pop(name).percentile_us(50))
    return {each: _paced(trace, pace) for each, trace in found.items()}


def _paced(trace: LatencyTrace, pace: float) -> LatencyTrace:
    return LatencyTrace(
        trace.model_sha256,
        trace.machine,
        tuple(round(sample * pace) for sample in trace.samples_us),
    )


def _kept(
    study: Study, each: Contender, workplace: Workplace, listener: Listener
) -> LatencyTrace | None:
    if each.scheme.trace is not None:
        return LatencyTrace.load(each.scheme.trace)
    path = workplace.trace(each.scheme)
    if each.model is None or not path.is_file():
        return None
    trace = LatencyTrace.load(path)
    same = trace.model_sha256 == each.sha256
    if same and len(trace.samples_us) == study.timing.samples:
        return trace
    listener.on_warning(f"{path}: of another model or length: measured again")
    return None


def _scale(study: Study, traces: Mapping[str, LatencyTrace]) -> float:
    """Choose the one scale that gives the baseline the median asked for."""
    wanted_s = study.timing.baseline_median_s
    if wanted_s is None:
        return 1.0
    if study.baseline not in traces:
        raise EvaluationError(
            f"latency: the device scale wants a median of {wanted_s} s of "
            f"{study.baseline}, and there is no trace of it"
        )
    median_us = traces[study.baseline].percentile_us(50)
    if not median_us:
        raise EvaluationError(
            f"latency: {study.baseline} has a median of 0 us: no scale makes it "
            f"{wanted_s} s"
        )
    return 1e6 * wanted_s / median_us
