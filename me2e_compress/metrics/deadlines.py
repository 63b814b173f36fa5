"""Share of decisions that exceed their latency budget."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from me2e_compress.base.display import Table, format_number, missing_note, plural, table
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics.episode import FRAME_US, Episode
from me2e_compress.metrics.measure import Measure, percentile, too_few
from me2e_compress.metrics.route_scores import TTC_CRITICAL_S

PERCENTILES = {f"p{percent:g}_ms": percent for percent in (50.0, 99.0, 99.9)}
CRITICAL, OTHER = "critical_mean_ms", "other_mean_ms"
UNSEEN = Measure(None, "ms", "nobody looked at the road")


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Latencies compared with a budget.

    Attributes:
        measures: By name: the percentiles, which have no value if too few samples were
            measured for them, ``mean_ms``, ``max_ms``, ``over_budget_percent``, and the
            means over decisions on frames with a time to collision below 1.5 s, and on
            other frames.
    """

    budget_ms: float
    count: int
    measures: Mapping[str, Measure]

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers, null for what was not measured."""
        values = {name: measure.value for name, measure in self.measures.items()}
        return {"budget_ms": self.budget_ms, "decisions": self.count, **values}


def deadlines(
    latencies_us: Sequence[int],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines:
    """Compare latencies with a budget; a latency of exactly the budget is in time.

    ``measured`` is the number of samples in the trace that the latencies were drawn
    from; None if each was measured on its own.
    """
    # A percentile needs enough samples of its own
    count, none = len(latencies_us), "no decision was taken"
    samples = count if measured is None else min(count, measured)
    late = sum(latency_us > 1e3 * budget_ms for latency_us in latencies_us)
    measures = dict[str, Measure]()
    for name, percent in PERCENTILES.items():
        why = too_few(percent, samples) if count else none
        value = None if why else percentile(latencies_us, percent) / 1e3
        measures[name] = Measure(value, "ms", why)
    measures["mean_ms"] = _mean(latencies_us, none)
    measures["max_ms"] = _mean([max(latencies_us)] if count else (), none)
    over = Measure(100.0 * late / count, "%") if count else Measure(None, "%", none)
    measures |= {"over_budget_percent": over, CRITICAL: UNSEEN, OTHER: UNSEEN}
    return Deadlines(budget_ms, count, measures)


def charged(
    episodes: Iterable[Episode],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines | None:
    """Compare the latencies charged in episodes with a budget; None if all are zero.

    ``measured`` is the one of :func:`deadlines`.
    """
    # All latencies, and those on frames with a low time to collision or on others
    latencies, critical, other = list[int](), list[int](), list[int]()
    for episode in episodes:
        ttc_s = () if episode.conflicts is None else episode.conflicts.ttc_s
        for decision in episode.decisions:
            latencies.append(decision.latency_us)
            frame = decision.time_us // FRAME_US
            if frame < len(ttc_s):
                seconds = ttc_s[frame]
                near = seconds is not None and seconds < TTC_CRITICAL_S
                (critical if near else other).append(decision.latency_us)
    if not any(latencies):
        return None
    compared = deadlines(latencies, budget_ms, measured)
    by_frame = {
        CRITICAL: _mean(critical, "no decision on a frame with TTC below 1.5 s"),
        OTHER: _mean(other, "no decision on another frame"),
    }
    return replace(compared, measures={**compared.measures, **by_frame})


def _mean(latencies_us: Sequence[int], why: str) -> Measure:
    if not latencies_us:
        return Measure(None, "ms", why)
    return Measure(fmean(latencies_us) / 1e3, "ms")


def deadlines_table(title: str, deadlines: Deadlines) -> Table:
    """Return percentiles, and how many decisions took longer than the budget."""
    names = {name: f"p{percent:g}" for name, percent in PERCENTILES.items()}
    names |= {"max_ms": "max", "mean_ms": "mean"}
    names["over_budget_percent"] = f"over {deadlines.budget_ms:g} ms"
    if deadlines.measures[CRITICAL].value is not None:
        names |= {CRITICAL: "mean, TTC below 1.5 s", OTHER: "mean, other frames"}
    shown = {words: deadlines.measures[name] for name, words in names.items()}
    why = {words: e.reason for words, e in shown.items() if e.value is None}
    return table(
        f"{title}: {plural(deadlines.count, 'decision')}",
        ("latency", "", "unit"),
        [(words, format_number(e.value, ".2f"), e.unit) for words, e in shown.items()],
        missing_note(why),
    )
