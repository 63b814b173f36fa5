"""What tables need of one driven route: a line of numbers, without frames.

Whatever is compared between two drives is compared here, route by route.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any, Self

import numpy as np
from pydantic import ConfigDict, with_config

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics import bench2drive
from me2e_compress.metrics import route_scores as scored
from me2e_compress.metrics.episode import COLLISIONS, Episode, InfractionKind
from me2e_compress.metrics.measure import (
    Bounds,
    Estimate,
    mean_estimate,
    unseen_interval,
)

PERCENTS = (50, 90, 99, 100)  # percentiles of the latencies of a route's decisions
DIGITS = 6  # digits that files keep, as the leaderboard does of scores

WORDS = {
    InfractionKind.COLLISION_PEDESTRIAN: "collision with a pedestrian",
    InfractionKind.COLLISION_VEHICLE: "collision with a vehicle",
    InfractionKind.COLLISION_LAYOUT: "collision with an obstacle",
    InfractionKind.RED_LIGHT: "red light",
    InfractionKind.STOP: "stop sign",
    InfractionKind.GIVE_WAY: "give-way sign",
    InfractionKind.OUTSIDE_ROUTE_LANES: "outside its lanes",
    InfractionKind.MIN_SPEED: "too slow",
    InfractionKind.YIELD_TO_EMERGENCY_VEHICLE: "no way for an emergency vehicle",
    InfractionKind.SCENARIO_TIMEOUT: "scenario timed out",
    InfractionKind.ROUTE_DEVIATION: "left the route",
    InfractionKind.VEHICLE_BLOCKED: "blocked",
    InfractionKind.ROUTE_TIMEOUT: "timed out",
}

_STRICT = ConfigDict(allow_inf_nan=False, extra="forbid")


@with_config(_STRICT)
@dataclass(frozen=True)
class RouteSummary:
    """One route of one drive; unrecorded values are None."""

    route: str
    scenario: str
    driving_score: float  # percent, as are completion, efficiency and ttc_exposure
    completion: float
    succeeded: bool  # whether the whole route was driven without an infraction
    ending: str
    # Kind, microseconds if known, and the other party
    infractions: tuple[tuple[str, int | None, str], ...]
    efficiency: float | None  # None if no traffic moved, or the ego did not
    comfort: float | None  # share of smooth segments; None if there was no whole one
    duration_us: int  # time of the last frame
    decisions: int
    latency_us: tuple[int, ...]  # `PERCENTS` of the decisions' latencies on the vehicle
    latency_sum_us: int
    ttc_exposure: float | None = None  # percent of frames with TTC below 1.5 s
    smallest_ttc: float | None = None
    smallest_pet: float | None = None  # seconds, of crossing paths
    smallest_distance: float | None = None
    at_fault: bool | None = None
    # Efficiency in the arithmetic of Bench2Drive's tools; the earliest files lack it,
    # as they lack the next
    bench2drive_efficiency: float | None = None
    bench2drive_smoothness: float | None = None  # their comfort

    @property
    def room_kept(self) -> float | None:
        """How much room it kept to others, a grade from 0 to 100 percent."""
        return scored.room_of(self.ttc_exposure, self.smallest_pet, self.at_fault)

    @property
    def moments(self) -> tuple[tuple[str, int | None], ...]:
        """Kind and time of each infraction but being too slow, which has no moment."""
        slow = InfractionKind.MIN_SPEED
        return tuple((kind, us) for kind, us, _ in self.infractions if kind != slow)

    @property
    def fate(self) -> str:
        """The infractions in words, or how the route ended."""
        kinds = [WORDS[InfractionKind(kind)] for kind, _ in self.moments]
        return ", ".join(dict.fromkeys(kinds)) or self.ending

    @property
    def collisions(self) -> tuple[tuple[str, str], ...]:
        """Kind and other party of each collision."""
        crashes = (one for one in self.infractions if one[0] in COLLISIONS)
        return tuple((kind, detail) for kind, _, detail in crashes)

    @classmethod
    def of(cls, episode: Episode) -> Self:
        """Summarize an episode; a real run may log steps instead of decisions."""
        # Percentiles of the latency that the drive was charged
        charged = [decision.latency_us for decision in episode.decisions]
        latency_us = np.percentile(charged or [0], PERCENTS, method="higher")
        steps = 0 if episode.given is None else len(episode.frames)
        return cls(
            route=episode.route,
            scenario=episode.scenario,
            driving_score=scored.route_score(episode).composed,
            completion=episode.completion_percent,
            succeeded=episode.succeeded,
            ending=episode.ending.value,
            infractions=tuple(
                (e.kind.value, e.time_us, e.detail) for e in episode.infractions
            ),
            efficiency=scored.efficiency(episode).value,
            comfort=scored.comfort(episode).value,
            duration_us=episode.frames[-1].time_us if episode.frames else 0,
            decisions=len(charged) or steps,
            latency_us=tuple(map(int, latency_us)) if charged else (),
            latency_sum_us=sum(charged),
            ttc_exposure=scored.ttc_exposure(episode).value,
            smallest_ttc=scored.smallest_ttc(episode).value,
            smallest_pet=scored.smallest_pet(episode).value,
            smallest_distance=scored.smallest_distance(episode).value,
            at_fault=scored.at_fault_collision(episode),
            bench2drive_efficiency=bench2drive.efficiency(episode).value,
            bench2drive_smoothness=bench2drive.smoothness(episode).value,
        )

    def rounded(self) -> Self:
        """Return it with the digits that files hold."""
        floats = ((k, v) for k, v in vars(self).items() if isinstance(v, float))
        rounded: dict[str, Any] = {name: round(value, DIGITS) for name, value in floats}
        return replace(self, **rounded)


POINTS = "points"  # difference of two percentages
PERCENT, SHARE = (0.0, 100.0), (0.0, 1.0)  # bounds of a route's values


@dataclass(frozen=True)
class RouteValues:
    """Numbers of the routes that have one; a difference is of routes that both have."""

    name: str
    unit: str
    by_route: Mapping[str, float]
    types: Mapping[str, str]  # scenario types, by route
    bounds: Bounds | None  # smallest and largest value of a route, if there are any
    missing: str  # why no route has a number

    def __sub__(self, other: "RouteValues") -> "RouteValues":
        bounds = None
        if self.bounds is not None and other.bounds is not None:
            (low, high), (least, most) = self.bounds, other.bounds
            bounds = low - most, high - least
        both = [route for route in self.by_route if route in other.by_route]
        shared = {route: self.by_route[route] - other.by_route[route] for route in both}
        # A drive without a single number says why
        missing = f"no route has a {self.name} in both drives"
        if not (self.by_route and other.by_route):
            missing = other.missing if self.by_route else self.missing
        unit = POINTS if self.unit == "%" else self.unit
        return replace(self, unit=unit, by_route=shared, bounds=bounds, missing=missing)

    def mean(self, seed: int = 0) -> Estimate:
        """Return the mean over routes with its intervals."""
        if not self.by_route:
            return Estimate.missing(self.unit, self.missing)
        types = [self.types[route] for route in self.by_route]
        values = list(self.by_route.values())
        return mean_estimate(values, types, self.unit, seed, self.bounds)


@dataclass(frozen=True)
class RouteColumn:
    """One number of every route; None if it was not measured."""

    name: str
    unit: str
    of: Callable[[RouteSummary], float | None]
    bounds: Bounds | None = None

    def values(self, routes: Sequence[RouteSummary], why: str = "") -> RouteValues:
        """Return the numbers of a drive; ``why`` there are no routes, if so."""
        values, types = dict[str, float](), dict[str, str]()
        for route in routes:
            types[route.route] = route.scenario
            if (value := self.of(route)) is not None:
                values[route.route] = value
        why = why or f"no route has a {self.name}"
        return RouteValues(self.name, self.unit, values, types, self.bounds, why)


DS = RouteColumn("DS", "%", lambda route: route.driving_score, PERCENT)
SR = RouteColumn("SR %", "%", lambda route: 100.0 * route.succeeded, PERCENT)
DE = RouteColumn("DE %", "%", lambda route: route.efficiency)
DC = RouteColumn("DC", "ratio", lambda route: route.comfort, SHARE)
ROOM = RouteColumn("room %", "%", lambda route: route.room_kept, PERCENT)
DE_B2D = RouteColumn("DE b2d %", "%", lambda route: route.bench2drive_efficiency)
DC_B2D = RouteColumn(
    "DC b2d", "ratio", lambda route: route.bench2drive_smoothness, SHARE
)
# The paper's scores of a route; b2d: in the arithmetic of Bench2Drive's tools
COLUMNS = (DS, ROOM, SR, DE, DE_B2D, DC, DC_B2D)


# Standard deviation, points a route, of the driving score's paired difference between
# the driver that ships and its int8 forms on the 220 routes, ten decisions a second:
# 23.0, 27.6 and 28.0 (`benchmarks/road_2/paper`). Where decisions cost what they take
# on a slow device it is 33 to 36.
SCATTER = 26.0

Z = 1.96  # standard score of a 95 % interval


def smallest_difference(routes: int) -> float:
    """Return the smallest difference that so many routes can show, in points."""
    return Z * SCATTER / math.sqrt(routes)


@dataclass(frozen=True, slots=True)
class PairedDifference:
    """Means over routes of "this variant minus the reference", in percentage points.

    What makes a route hard for both cancels out, so the intervals are narrower than
    those of the two means suggest. The interval over these scenario types is never
    narrower than what so few routes can exclude (`metrics.measure.unseen_share`).
    """

    driving_score: Estimate
    room_kept: Estimate
    success_rate: Estimate
    routes_better: int  # routes with a higher driving score than the reference's
    routes_worse: int
    success_gained: int = 0  # routes on which only this variant succeeds
    success_lost: int = 0  # routes on which only the reference succeeds
    # Two-sided p-value of McNemar's exact test that success is equally frequent; routes
    # are treated as independent
    mcnemar_p: float = 1.0

    @property
    def least_detectable(self) -> float:
        """Smallest difference of driving scores that these routes detect, in points.

        Half the interval's width, under the usual scatter (`SCATTER`) or more.
        """
        score, usual = self.driving_score, smallest_difference(self.driving_score.n)
        if score.low is None or score.high is None:
            return usual
        return max(usual, (score.high - score.low) / 2)

    @property
    def verdict(self) -> str:
        """Say in a word or two what these routes show about the driving score."""
        score = self.driving_score
        if abs(score.value or 0.0) < smallest_difference(score.n) or score.low is None:
            return "too few routes"
        return ("no difference shown", "better", "worse")[score.sign]


def difference(
    routes: Sequence[RouteSummary], reference: Sequence[RouteSummary], seed: int = 0
) -> PairedDifference:
    """Compare two drives of the same routes, at least one, route by route.

    Raises:
        EvaluationError: A route was driven by one of the two only.
    """
    from scipy.stats import binomtest  # takes a second to import

    # Routes must match, whatever their order
    ours, others = ({route.route for route in drive} for drive in (routes, reference))
    if unpaired := sorted(ours ^ others):
        raise EvaluationError(
            f"route {unpaired[0]} was driven by one of the two only: differences are "
            "taken over the same routes"
        )
    scores, room, rates = (
        column.values(routes) - column.values(reference) for column in (DS, ROOM, SR)
    )
    # Only routes with different outcomes count in McNemar's test
    gaps, turns = scores.by_route.values(), rates.by_route.values()
    gained, lost = sum(turn > 0 for turn in turns), sum(turn < 0 for turn in turns)
    p_value = float(binomtest(gained, gained + lost).pvalue) if gained + lost else 1.0
    return PairedDifference(
        _estimate(scores, seed),
        _estimate(room, seed),
        _estimate(rates, seed),
        sum(gap > 0 for gap in gaps),
        sum(gap < 0 for gap in gaps),
        gained,
        lost,
        p_value,
    )


def _estimate(values: RouteValues, seed: int) -> Estimate:
    """Return a mean of differences, its interval no narrower than n routes allow.

    The interval over types drawn anew is at least as wide as that over these types.
    """
    mean = values.mean(seed)
    if mean.value is None or mean.low is None or mean.high is None:
        return mean
    # Widen the interval over these types
    least, most = unseen_interval(mean.value, mean.n, values.bounds)
    low = mean.low if least is None else min(least, mean.low)
    high = mean.high if most is None else max(most, mean.high)
    mean = replace(mean, low=low, high=high)
    # The interval over new types must contain it
    if mean.anew_low is None or mean.anew_high is None:
        return mean
    anew = min(low, mean.anew_low), max(high, mean.anew_high)
    return replace(mean, anew_low=anew[0], anew_high=anew[1])


def holm(p_values: Sequence[float]) -> tuple[float, ...]:
    """Return p-values corrected for multiple comparisons (Holm 1979), in their order.

    The smallest of m p-values is multiplied by m, the next by m - 1, and so on; each
    result is at least as large as the one before, and at most 1.
    """
    order = sorted(range(len(p_values)), key=lambda i: p_values[i])
    corrected, least = [1.0] * len(p_values), 0.0
    for rank, i in enumerate(order):
        least = max(least, min(1.0, p_values[i] * (len(p_values) - rank)))
        corrected[i] = least
    return tuple(corrected)
