"""How often a decision takes longer than it may."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from me2e_compress.metrics.episode import FRAME_US, Episode
from me2e_compress.metrics.measure import Measure

BUDGET_MS = FRAME_US / 1000
"""One frame at 20 Hz."""
PERCENTILES = (50.0, 99.0, 99.9)


@dataclass(frozen=True, slots=True)
class Deadlines:
    """Latencies held against a budget.

    Attributes:
        budget_ms: What a decision may take.
        count: Decisions.
        percentiles_ms: By percent: the latency that so many do not exceed; None where
            there are too few decisions for one to lie beyond it.
        mean_ms: Of all decisions.
        worst_ms: The longest.
        over_percent: Share of the decisions that took longer than the budget.
    """

    budget_ms: float
    count: int
    percentiles_ms: dict[float, Measure]
    mean_ms: Measure
    worst_ms: Measure
    over_percent: Measure

    def to_json(self) -> dict[str, Any]:
        """Return plain numbers, null where something was not measured."""
        named = {f"p{p:g}_ms": each.value for p, each in self.percentiles_ms.items()}
        return {
            "budget_ms": self.budget_ms,
            "decisions": self.count,
            **named,
            "mean_ms": self.mean_ms.value,
            "max_ms": self.worst_ms.value,
            "over_budget_percent": self.over_percent.value,
        }


def deadlines(latencies_us: Sequence[int], budget_ms: float = BUDGET_MS) -> Deadlines:
    """Hold latencies against a budget.

    Args:
        latencies_us: Microseconds, one a decision.
        budget_ms: What a decision may take; exactly so much is in time.
    """
    if not latencies_us:
        none = Measure(None, "ms", "no decision was taken")
        share = Measure(None, "%", none.reason)
        return Deadlines(
            budget_ms, 0, dict.fromkeys(PERCENTILES, none), none, none, share
        )
    late = sum(each > 1e3 * budget_ms for each in latencies_us)
    return Deadlines(
        budget_ms,
        len(latencies_us),
        {percent: _percentile(latencies_us, percent) for percent in PERCENTILES},
        Measure(fmean(latencies_us) / 1e3, "ms"),
        Measure(max(latencies_us) / 1e3, "ms"),
        Measure(100.0 * late / len(latencies_us), "%"),
    )


def charged(
    episodes: Iterable[Episode], budget_ms: float = BUDGET_MS
) -> Deadlines | None:
    """Hold what the decisions of episodes were charged against a budget.

    Args:
        episodes: Of one evaluation.
        budget_ms: What a decision may take.

    Returns:
        None where decisions cost nothing.
    """
    taken = [each.latency_us for episode in episodes for each in episode.decisions]
    return deadlines(taken, budget_ms) if any(taken) else None


def _percentile(latencies_us: Sequence[int], percent: float) -> Measure:
    needed = round(100.0 / (100.0 - percent))
    if len(latencies_us) < needed:
        return Measure(None, "ms", f"{len(latencies_us)} decisions, {needed} needed")
    # in whole numbers: 0.999 * 1000 is 999.0000000000001 in floating point
    rank = -(-len(latencies_us) * round(10 * percent) // 1000)
    return Measure(sorted(latencies_us)[rank - 1] / 1e3, "ms")
