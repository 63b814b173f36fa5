"""Paired differences of two drivers on the same routes."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.intervals import (
    mean_estimate,
    unseen_interval,
    unseen_share,
)
from me2e_compress.metrics.measure import Estimate

POINTS = "points"
"""Difference of two percentages."""

WIDEST = (-100.0, 100.0)
"""Bounds of a route's difference, in points."""


SCATTER = 12.0
"""Standard deviation, points a route, of the driving score's paired difference between
the driver that ships and its int8 forms on the 220 routes, decisions free: 11.2 to 12.9
(``benchmarks/driver/schemes``)."""

Z = 1.96
"""Standard score of a 95 % interval."""


def shown_by(routes: int) -> float:
    """Return the smallest difference that so many routes can show, in points."""
    return Z * SCATTER / math.sqrt(routes)


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Means over routes of "this variant minus the reference", in percentage points.

    What makes a route hard for both cancels out, so the intervals are narrower than
    those of the two means suggest. The interval over these scenario types is never
    narrower than what so few routes can exclude (`metrics.intervals.unseen_share`).
    ``better`` and ``worse`` count routes by driving score; ``gained`` and ``lost``
    count routes on which only this variant, or only the reference, succeeds.
    """

    driving_score: Estimate
    success_rate: Estimate
    better: int
    worse: int
    gained: int = 0
    lost: int = 0

    @property
    def differ(self) -> int:
        """Number of routes whose driving scores differ."""
        return self.better + self.worse

    @property
    def unseen_percent(self) -> float:
        """Upper 95 % bound of the share that could differ if none of these does."""
        return 100.0 * unseen_share(self.driving_score.n)

    @property
    def smallest_shown(self) -> float:
        """Smallest difference of driving scores that these routes can show, in points.

        It is half the width of the interval under the usual scatter (`SCATTER`), or of
        the actual interval if that is wider.
        """
        score, usual = self.driving_score, shown_by(self.driving_score.n)
        if score.low is None or score.high is None:
            return usual
        return max(usual, (score.high - score.low) / 2)

    @property
    def verdict(self) -> str:
        """Say in a word or two what these routes show about the driving score.

        Bounds are rounded to a tenth of a point, as they are printed.
        """
        score = self.driving_score
        if abs(score.value or 0.0) < shown_by(score.n) or score.low is None:
            return "too few routes"
        if round(score.low, 1) > 0.0:
            return "better"
        if score.high is not None and round(score.high, 1) < 0.0:
            return "worse"
        return "no difference shown"

    @property
    def p_value(self) -> float:
        """Two-sided p-value of McNemar's exact test that success is equally frequent.

        Only routes with different outcomes count; without any it is 1. Routes are
        treated as independent.
        """
        from scipy.stats import binomtest  # takes a second to import

        parted = self.gained + self.lost
        return float(binomtest(self.gained, parted).pvalue) if parted else 1.0

    def to_json(self) -> dict[str, Any]:
        """Return both estimates, all counts and the p-value."""
        return {
            "driving_score": self.driving_score.to_json(),
            "success_rate": self.success_rate.to_json(),
            "routes_better": self.better,
            "routes_worse": self.worse,
            "success_gained": self.gained,
            "success_lost": self.lost,
            "mcnemar_p": self.p_value,
        }


def difference(
    episodes: Sequence[Episode], reference: Sequence[Episode], seed: int = 0
) -> PairedDifference:
    """Compare two drives of the same routes, at least one, route by route."""
    # routes must match, whatever their order
    others = {episode.route: episode for episode in reference}
    unpaired = sorted({*others} ^ {episode.route for episode in episodes})
    if unpaired:
        raise EvaluationError(
            f"route {unpaired[0]} was driven by one of the two only: differences are "
            "taken over the same routes"
        )
    # one difference per route, with the route's scenario type
    pairs = [(one, others[one.route]) for one in episodes]
    types = [one.scenario for one in episodes]
    scores = [route_score(one).composed - route_score(o).composed for one, o in pairs]
    turns = [int(one.succeeded) - int(other.succeeded) for one, other in pairs]
    return PairedDifference(
        _estimate(scores, types, seed),
        _estimate([100.0 * turn for turn in turns], types, seed),
        sum(score > 0 for score in scores),
        sum(score < 0 for score in scores),
        turns.count(1),
        turns.count(-1),
    )


def _estimate(values: Sequence[float], types: Sequence[str], seed: int) -> Estimate:
    """Return a mean of differences, its interval no narrower than n routes allow.

    The interval over types drawn anew is at least as wide as that over these types.
    """
    found = mean_estimate(values, types, POINTS, seed, WIDEST)
    if found.value is None or found.low is None or found.high is None:
        return found
    # widen the interval over these types
    least, most = unseen_interval(found.value, found.n, WIDEST)
    low = found.low if least is None else min(least, found.low)
    high = found.high if most is None else max(most, found.high)
    # the interval over new types must contain it
    if found.anew_low is None or found.anew_high is None:
        return dataclasses.replace(found, low=low, high=high)
    return dataclasses.replace(
        found, low=low, high=high,
        anew_low=min(low, found.anew_low), anew_high=max(high, found.anew_high),
    )  # fmt: skip


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Return p-values corrected for multiple comparisons (Holm 1979), in their order.

    The smallest of m p-values is multiplied by m, the next by m - 1, and so on; each
    result is at least as large as the one before, and at most 1.
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    found, least = [1.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        least = max(least, min(1.0, p_values[i] * (len(p_values) - rank)))
        found[i] = least
    return tuple(found)
