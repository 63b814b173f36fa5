"""Paired differences of two drivers on the same routes."""

import dataclasses
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.intervals import unseen_interval, unseen_share
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import DS, ROOM, SR, RouteSummary, RouteValues

SCATTER = 26.0
"""Standard deviation, points a route, of the driving score's paired difference between
the driver that ships and its int8 forms on the 220 routes, ten decisions a second:
23.0, 27.6 and 28.0 (``benchmarks/road_2/paper``). Where decisions cost what they take
on a slow device it is 33 to 36."""

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
    room_kept: Estimate
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
        """Say in a word or two what these routes show about the driving score."""
        score = self.driving_score
        if abs(score.value or 0.0) < shown_by(score.n) or score.low is None:
            return "too few routes"
        return ("no difference shown", "better", "worse")[score.sign]

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
            "room_kept": self.room_kept.to_json(),
            "success_rate": self.success_rate.to_json(),
            "routes_better": self.better,
            "routes_worse": self.worse,
            "success_gained": self.gained,
            "success_lost": self.lost,
            "mcnemar_p": self.p_value,
        }


def difference(
    routes: Sequence[RouteSummary], reference: Sequence[RouteSummary], seed: int = 0
) -> PairedDifference:
    """Compare two drives of the same routes, at least one, route by route."""
    # routes must match, whatever their order
    ours, others = ({each.route for each in drive} for drive in (routes, reference))
    if unpaired := sorted(ours ^ others):
        raise EvaluationError(
            f"route {unpaired[0]} was driven by one of the two only: differences are "
            "taken over the same routes"
        )
    scores, room, rates = (
        column.values(routes) - column.values(reference) for column in (DS, ROOM, SR)
    )
    gaps, turns = scores.by_route.values(), rates.by_route.values()
    return PairedDifference(
        _estimate(scores, seed),
        _estimate(room, seed),
        _estimate(rates, seed),
        sum(gap > 0 for gap in gaps),
        sum(gap < 0 for gap in gaps),
        sum(turn > 0 for turn in turns),
        sum(turn < 0 for turn in turns),
    )


def _estimate(values: RouteValues, seed: int) -> Estimate:
    """Return a mean of differences, its interval no narrower than n routes allow.

    The interval over types drawn anew is at least as wide as that over these types.
    """
    found = values.mean(seed)
    if found.value is None or found.low is None or found.high is None:
        return found
    # widen the interval over these types
    least, most = unseen_interval(found.value, found.n, values.bounds)
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
