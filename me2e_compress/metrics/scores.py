"""All scores of a set of driven routes."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from statistics import fmean
from typing import Any

import numpy as np

from me2e_compress.metrics import bench2drive, route_scores
from me2e_compress.metrics.bench2drive import ABILITIES, mastered, success
from me2e_compress.metrics.episode import FAILURES, Episode
from me2e_compress.metrics.measure import (
    Bounds,
    Estimate,
    Floats,
    Measure,
    binomial_interval,
    intervals,
    mean_estimate,
)
from me2e_compress.metrics.route_summary import PERCENT, SHARE

FULL_SET = 220  # routes of a whole benchmark: 44 scenario types with 5 variants each


@dataclass(frozen=True, slots=True)
class SafetyScores:
    """How near the routes came to collisions; None where it was not recorded.

    The smallest values are means of the routes' minima, in seconds or metres.
    """

    room_kept: Estimate  # a grade from 0 to 100
    ttc_exposure: Estimate  # percent of frames with a time to collision below 1.5 s
    smallest_ttc: Estimate  # over routes on which a contact was ever within 10 s
    smallest_pet: Estimate  # over routes with crossing paths
    smallest_distance: Estimate
    at_fault_collisions: Estimate


@dataclass(frozen=True, slots=True)
class Scores:
    """Means over the driven routes, each with its interval, in percent.

    The fields ``bench2drive_...`` follow Bench2Drive's own arithmetic.
    """

    driving_score: Estimate
    success_rate: Estimate
    efficiency: Estimate
    comfort: Estimate  # the share of smooth segments (equation 7, SI units)
    abilities: Estimate
    each_ability: dict[str, Estimate]
    bench2drive_efficiency: Estimate
    bench2drive_smoothness: Estimate
    safety: SafetyScores
    routes: int
    expected: int
    # Why the policy or the simulator failed, by the route that this ended
    failures: Mapping[str, str] = field(default_factory=dict)

    @property
    def failed(self) -> str:
        """Number of routes that a failure ended, with one of them; empty if none."""
        for route, words in self.failures.items():
            return (
                f"{len(self.failures)} of {self.routes} routes ended because the policy"
                f" or the simulator failed: {words} ({route})"
            )
        return ""

    @property
    def partial(self) -> bool:
        """Whether routes are missing; the means leave them out, not as zeros."""
        return self.routes < self.expected

    def to_json(self) -> dict[str, Any]:
        """Return one object per score, and the number of routes."""
        plain = ("driving_score", "success_rate", "efficiency", "comfort")
        return {
            **{name: getattr(self, name) for name in plain},
            "abilities": {**self.abilities.to_json(), "each": self.each_ability},
            "bench2drive": {
                "efficiency": self.bench2drive_efficiency,
                "smoothness": self.bench2drive_smoothness,
            },
            "safety": self.safety,
            "routes": {
                "driven": self.routes,
                "expected": self.expected,
                "partial": self.partial,
                "failed": len(self.failures),
            },
        }


def score(
    episodes: Sequence[Episode], expected: int = FULL_SET, seed: int = 0
) -> Scores:
    """Score a set of routes, of ``expected`` ones in the whole set."""

    def driving_score(episode: Episode) -> Measure:
        return Measure(route_scores.route_score(episode).composed, "%")

    # A rate over routes without a collision alone would be nothing but zeros
    faults = [route_scores.at_fault_collision(episode) for episode in episodes]
    if unknown := faults.count(None):
        reason = f"whose fault {unknown} collisions were is not known"
        at_fault = Estimate.missing("%", reason)
    else:
        at_fault = _rate(episodes, list(map(bool, faults)), seed)
    safety = SafetyScores(
        _mean(episodes, route_scores.room_kept, "%", seed, PERCENT),
        _mean(episodes, route_scores.ttc_exposure, "%", seed, PERCENT),
        _mean(episodes, route_scores.smallest_ttc, "s", seed),
        _mean(episodes, route_scores.smallest_pet, "s", seed),
        _mean(episodes, route_scores.smallest_distance, "m", seed),
        at_fault,
    )
    # All other scores, ours and in Bench2Drive's arithmetic
    mean_ability, each_ability = _abilities(episodes, seed)
    smoothness = bench2drive.smoothness
    return Scores(
        driving_score=_mean(episodes, driving_score, "%", seed, PERCENT),
        success_rate=_rate(episodes, [one.succeeded for one in episodes], seed),
        efficiency=_mean(episodes, route_scores.efficiency, "%", seed),
        comfort=_mean(episodes, route_scores.comfort, "ratio", seed, SHARE),
        abilities=mean_ability,
        each_ability=each_ability,
        bench2drive_efficiency=_mean(episodes, bench2drive.efficiency, "%", seed),
        bench2drive_smoothness=_mean(episodes, smoothness, "ratio", seed, SHARE),
        safety=safety,
        routes=len(episodes),
        expected=expected,
        failures={
            episode.route: episode.failure or episode.ending.value
            for episode in episodes
            if episode.ending in FAILURES
        },
    )


def _mean(
    episodes: Sequence[Episode],
    metric: Callable[[Episode], Measure],
    unit: str,
    seed: int,
    bounds: Bounds | None = None,
) -> Estimate:
    """Return the mean of a metric over the routes that have it, with its intervals."""
    measured = [(metric(episode), episode.scenario) for episode in episodes]
    known = [(own.value, kind) for own, kind in measured if own.value is not None]
    if not known:
        reason = measured[0][0].reason if measured else "no route was driven"
        return Estimate.missing(unit, reason)
    values, types = zip(*known, strict=True)
    return mean_estimate(values, types, unit, seed, bounds)


def _rate(episodes: Sequence[Episode], outcomes: Sequence[bool], seed: int) -> Estimate:
    """Return a rate with its exact interval, and the one over types drawn anew."""
    if not outcomes:
        return Estimate.missing("%", "no such route was driven")
    types = [episode.scenario for episode in episodes]
    percents = [100.0 * outcome for outcome in outcomes]
    mean = mean_estimate(percents, types, "%", seed, PERCENT)
    low, high = binomial_interval(sum(outcomes), len(outcomes))
    return replace(mean, low=low, high=high)


def _abilities(
    episodes: Sequence[Episode], seed: int
) -> tuple[Estimate, dict[str, Estimate]]:
    """Return the mean of the five abilities' success rates, and each of them."""
    # Which abilities each route tests, and which of those it masters
    shape = len(episodes), len(ABILITIES)
    tests, good = np.zeros(shape, np.bool_), np.zeros(shape)  # (routes, abilities)
    rates = dict[str, Estimate]()
    for column, name in enumerate(ABILITIES):
        tests[:, column] = [name in episode.abilities for episode in episodes]
        tested = [episode for episode in episodes if name in episode.abilities]
        outcomes = [mastered(episode, name) for episode in tested]
        good[tests[:, column], column] = [bool(outcome) for outcome in outcomes]
        unknown = [
            episode.route
            for episode, outcome in zip(tested, outcomes, strict=True)
            if outcome is None
        ]
        if unknown:
            others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
            reason = f"where the junction is on {unknown[0]}{others} is not known"
            rates[name] = Estimate.missing("%", reason, len(tested))
        else:
            rates[name] = _rate(tested, list(map(bool, outcomes)), seed)
    # The mean needs all five abilities
    if undriven := [name for name, rate in rates.items() if not rate.n]:
        reason = f"no route for {', '.join(undriven)} was driven"
        return Estimate.missing("%", reason), rates
    for name, rate in rates.items():
        if rate.value is None:
            return Estimate.missing("%", f"{name}: {rate.measure.reason}"), rates

    def mean_rate(weights: Floats) -> Floats:
        n = weights @ tests  # (resamples, abilities)
        drawn = np.full(n.shape, np.nan)
        np.divide(weights @ good, n, out=drawn, where=n > 0)
        # Resampled routes may test none of an ability: hence nanmean
        return np.asarray(100.0 * np.nanmean(drawn, axis=1))

    value = fmean(rate.value or 0.0 for rate in rates.values())
    types = [episode.scenario for episode in episodes]
    here, anew = intervals(mean_rate, types, seed, value, PERCENT)
    return Estimate(Measure(value, "%"), *here, len(episodes), *anew), rates


# Scores of a set of records, as the simulator wrote them and as computed here.
# Bench2Drive's tools/merge_route_json.py divides by 220 however many records there are,
# so that a missing route counts as zero; both quotients are given.


@dataclass(frozen=True, slots=True)
class Quotients:
    """A sum over records, divided by the size of the set or by the records; or None."""

    set: float | None = None
    driven: float | None = None


@dataclass(frozen=True, slots=True)
class LeaderboardScores:
    """Scores of records, as given by the simulator and as computed here."""

    set_size: int
    driven: int
    given: Mapping[str, Quotients]
    computed: Mapping[str, Quotients]


def leaderboard_scores(
    episodes: Sequence[Episode], set_size: int = FULL_SET
) -> LeaderboardScores:
    """Score a set of records as the leaderboard and as Bench2Drive's tools do."""
    given = [episode.given for episode in episodes if episode.given is not None]
    scored = [route_scores.route_score(episode) for episode in episodes]

    def quotients(values: Sequence[float]) -> Quotients:
        if not values:
            return Quotients()
        return Quotients(sum(values) / set_size, fmean(values))

    reported = {
        "driving_score": quotients([report.composed_percent for report in given]),
        "completion": quotients([report.completion_percent for report in given]),
        "penalty": quotients([report.penalty for report in given]),
    }
    computed = {
        "driving_score": quotients([result.composed for result in scored]),
        "penalty": quotients([result.penalty for result in scored]),
        "success_rate": quotients([100.0 * success(episode) for episode in episodes]),
    }
    return LeaderboardScores(set_size, len(episodes), reported, computed)
