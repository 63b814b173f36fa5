"""Paired differences of two drivers on the same routes."""

from collections.abc import Sequence
from dataclasses import dataclass
from statistics import fmean
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.intervals import paired_interval
from me2e_compress.metrics.measure import Estimate, Measure

POINTS = "points"
"""Difference of two percentages."""


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Means over routes of "this one minus the reference", each with its interval.

    Attributes:
        driving_score: Percentage points.
        success_rate: Percentage points.
        better: Routes with a higher driving score than the reference's.
        worse: Routes with a lower one.
    """

    driving_score: Estimate
    success_rate: Estimate
    better: int
    worse: int

    def to_json(self) -> dict[str, Any]:
        """Return both estimates and both counts."""
        return {
            "driving_score": self.driving_score.to_json(),
            "success_rate": self.success_rate.to_json(),
            "routes_better": self.better,
            "routes_worse": self.worse,
        }


def difference(
    episodes: Sequence[Episode], reference: Sequence[Episode], seed: int = 0
) -> PairedDifference:
    """Compare two drives route by route; at least one route is needed.

    Args:
        episodes: One a route.
        reference: The same routes, in any order.
        seed: Of the bootstrap.

    Raises:
        EvaluationError: The two were not driven on the same routes.
    """
    others = {episode.route: episode for episode in reference}
    unpaired = sorted({*others} ^ {episode.route for episode in episodes})
    if unpaired:
        raise EvaluationError(
            f"route {unpaired[0]} was driven by one of the two only: differences are "
            "taken over the same routes"
        )
    pairs = [(one, others[one.route]) for one in episodes]
    scores = [
        (route_score(one).composed, route_score(other).composed) for one, other in pairs
    ]
    rates = [(100.0 * one.succeeded, 100.0 * other.succeeded) for one, other in pairs]
    return PairedDifference(
        _estimate(scores, seed),
        _estimate(rates, seed),
        sum(one > other for one, other in scores),
        sum(one < other for one, other in scores),
    )


def _estimate(pairs: Sequence[tuple[float, float]], seed: int) -> Estimate:
    values, reference = zip(*pairs, strict=True)
    low, high = paired_interval(values, reference, seed)
    mean = fmean(one - other for one, other in pairs)
    return Estimate(Measure(mean, POINTS), low, high, len(pairs))
