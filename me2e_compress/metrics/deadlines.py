"""Share of decisions that exceed their latency budget."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from me2e_compress.display import Table, format_number, missing_note, plural, table
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
        values = {name: each.value for name, each in self.measures.items()}
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
    count, none = len(latencies_us), "no decision was taken"
    if not count:
        unknown, share = Measure(None, "ms", none), Measure(None, "%", none)
        names = (*PERCENTILES, "mean_ms", "max_ms")
        named = dict.fromkeys(names, unknown) | {"over_budget_percent": share}
        return Deadlines(budget_ms, 0, named | {CRITICAL: UNSEEN, OTHER: UNSEEN})
    samples = count if measured is None else min(count, measured)
    late = sum(each > 1e3 * budget_ms for each in latencies_us)
    measures = dict[str, Measure]()
    for name, percent in PERCENTILES.items():
        why = too_few(percent, samples)
        value = None if why else percentile(latencies_us, percent) / 1e3
        measures[name] = Measure(value, "ms", why)
    measures["mean_ms"] = _mean(latencies_us, none)
    measures["max_ms"] = Measure(max(latencies_us) / 1e3, "ms")
    measures["over_budget_percent"] = Measure(100.0 * late / count, "%")
    return Deadlines(budget_ms, count, {**measures, CRITICAL: UNSEEN, OTHER: UNSEEN})


def charged(
    episodes: Iterable[Episode],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines | None:
    """Compare the latencies charged in episodes with a budget; None if all are zero.

    ``measured`` is the one of :func:`deadlines`.
    """
    driven = tuple(episodes)
    taken = [each.latency_us for episode in driven for each in episode.decisions]
    if not any(taken):
        return None
    # latencies on frames with a low time to collision, and on others
    critical, other = list[int](), list[int]()
    for episode in driven:
        ttc_s = () if episode.conflicts is None else episode.conflicts.ttc_s
        for decision in episode.decisions:
            frame = decision.time_us // FRAME_US
            if frame < len(ttc_s):
                seconds = ttc_s[frame]
                near = seconds is not None and seconds < TTC_CRITICAL_S
                (critical if near else other).append(decision.latency_us)
    compared = deadlines(taken, budget_ms, measured)
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
    why = {words: each.reason for words, each in shown.items() if each.value is None}
    return table(
        f"{title}: {plural(deadlines.count, 'decision')}",
        ("latency", "", "unit"),
        [(words, format_number(e.value, ".2f"), e.unit) for words, e in shown.items()],
        missing_note(why),
    )
