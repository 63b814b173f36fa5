"""Share of decisions that exceed their latency budget."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass, replace
from statistics import fmean
from typing import Any

from me2e_compress.display import Table, counted, not_measured, number, table
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics.episode import FRAME_US, Episode
from me2e_compress.metrics.measure import Measure, percentile, too_few
from me2e_compress.metrics.route_scores import TTC_CRITICAL_S

PERCENTILES = (50.0, 99.0, 99.9)
UNSEEN = Measure(None, "ms", "nobody looked at the road")


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Latencies compared with a budget.

    Attributes:
        percentiles_ms: By percent; no value if too few samples were measured for it.
        critical_ms: Mean over the decisions on frames with a time to collision below
            1.5 s.
        other_ms: Mean over the decisions on the other frames.
    """

    budget_ms: float
    count: int
    percentiles_ms: dict[float, Measure]
    mean_ms: Measure
    worst_ms: Measure
    over_percent: Measure
    critical_ms: Measure = UNSEEN
    other_ms: Measure = UNSEEN

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers, null for what was not measured."""
        named = {f"p{p:g}_ms": each.value for p, each in self.percentiles_ms.items()}
        return {
            "budget_ms": self.budget_ms,
            "decisions": self.count,
            **named,
            "mean_ms": self.mean_ms.value,
            "max_ms": self.worst_ms.value,
            "over_budget_percent": self.over_percent.value,
            "critical_mean_ms": self.critical_ms.value,
            "other_mean_ms": self.other_ms.value,
        }


def deadlines(
    latencies_us: Sequence[int],
    budget_ms: float = BUDGET_MS,
    measured: int | None = None,
) -> Deadlines:
    """Compare latencies with a budget; a latency of exactly the budget is in time.

    ``measured`` is the number of samples in the trace that the latencies were drawn
    from; None if each was measured on its own.
    """
    if not latencies_us:
        none = Measure(None, "ms", "no decision was taken")
        share = Measure(None, "%", none.reason)
        return Deadlines(
            budget_ms, 0, dict.fromkeys(PERCENTILES, none), none, none, share
        )
    count = len(latencies_us)
    samples = count if measured is None else min(count, measured)
    late = sum(each > 1e3 * budget_ms for each in latencies_us)
    percentiles = dict[float, Measure]()
    for p in PERCENTILES:
        why = too_few(p, samples)
        value = None if why else percentile(latencies_us, p) / 1e3
        percentiles[p] = Measure(value, "ms", why)
    return Deadlines(
        budget_ms,
        count,
        percentiles,
        Measure(fmean(latencies_us) / 1e3, "ms"),
        Measure(max(latencies_us) / 1e3, "ms"),
        Measure(100.0 * late / count, "%"),
    )


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
    return replace(
        deadlines(taken, budget_ms, measured),
        critical_ms=_mean(critical, "no decision on a frame with TTC below 1.5 s"),
        other_ms=_mean(other, "no decision on another frame"),
    )


def _mean(latencies_us: Sequence[int], why: str) -> Measure:
    if not latencies_us:
        return Measure(None, "ms", why)
    return Measure(fmean(latencies_us) / 1e3, "ms")


def deadlines_table(title: str, deadlines: Deadlines) -> Table:
    """Return percentiles, and how many decisions took longer than the budget."""
    rows = [(n, number(each.value, ".2f"), each.unit) for n, each in _each(deadlines)]
    why = {name: each.reason for name, each in _each(deadlines) if each.value is None}
    return table(
        f"{title}: {counted(deadlines.count, 'decision')}",
        ("latency", "", "unit"),
        rows,
        not_measured(why),
    )


def _each(deadlines: Deadlines) -> Iterator[tuple[str, Measure]]:
    yield from ((f"p{p:g}", each) for p, each in deadlines.percentiles_ms.items())
    yield "max", deadlines.worst_ms
    yield "mean", deadlines.mean_ms
    yield f"over {deadlines.budget_ms:g} ms", deadlines.over_percent
    if deadlines.critical_ms.value is not None:
        yield "mean, TTC below 1.5 s", deadlines.critical_ms
        yield "mean, other frames", deadlines.other_ms
