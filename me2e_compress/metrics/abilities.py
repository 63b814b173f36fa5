"""Bench2Drive's five abilities: which routes count as successes, and the rates.

A route counts under every ability that it tests; routes without a record are not
counted. For Traffic_Signs a route also *passes the junction* (J) if the ego came more
than 8 m into it and ran no stop sign or red light. In Bench2Drive's words: if its
completion exceeds (c + 8) / n, where n is the number of points of its dense route and c
the index of the first one on a junction. With S for a success, over N routes
(tools/ability_benchmark.py):

* 0.0.3 adds the two: sum(S + J) / 2 N;
* 0.0.4 takes either: sum(S or J) / N, as we do.
"""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Literal, get_args

from me2e_compress.metrics.bench2drive import success
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.intervals import binomial_interval
from me2e_compress.metrics.measure import Estimate, Measure

ABILITIES = (
    "Overtaking",
    "Merging",
    "Emergency_Brake",
    "Give_Way",
    "Traffic_Signs",
)
TRAFFIC_SIGNS = "Traffic_Signs"
MEAN = "mean"

Rules = Literal["0.0.3", "0.0.4"]
RULES: tuple[Rules, ...] = get_args(Rules)

JUNCTION_MARGIN_M = 8.0
"""How far past the start of a junction the ego must come to have obeyed its signs."""


def mastered(episode: Episode, ability: str) -> bool:
    """Return whether a route of ours counts as a success for one of its abilities."""
    if episode.succeeded:
        return True
    if ability != TRAFFIC_SIGNS or episode.junction_m is None:
        return False
    passed_m = episode.completion_percent / 100.0 * episode.route_length_m
    return passed_m > episode.junction_m + JUNCTION_MARGIN_M and not _ran_a_sign(
        episode
    )


def successes(episodes: Sequence[Episode]) -> dict[str, tuple[bool, ...]]:
    """Return, for each ability, whether each route that tests it was mastered."""
    return {
        ability: tuple(
            mastered(episode, ability)
            for episode in episodes
            if ability in episode.abilities
        )
        for ability in ABILITIES
    }


def ability_rates(
    episodes: Sequence[Episode], rules: Rules, junctions: Mapping[str, float]
) -> dict[str, Estimate]:
    """Return the rate of each ability in percent, and their arithmetic mean.

    ``junctions`` holds (c + 8) / n by route. If a value that matters is missing, the
    rate of Traffic_Signs is None, and so is the mean.
    """
    rates = {
        ability: _rate([one for one in episodes if ability in one.abilities])
        for ability in ABILITIES
    }
    signs = [one for one in episodes if TRAFFIC_SIGNS in one.abilities]
    rates[TRAFFIC_SIGNS] = _signs(signs, rules, junctions)
    return {**rates, MEAN: _mean(rates, len(episodes))}


def passes_the_junction(
    episode: Episode, junctions: Mapping[str, float]
) -> bool | None:
    """Return J of a route; None if it depends on an unknown junction."""
    if _ran_a_sign(episode) or episode.completion_percent <= 0.0:
        return False
    place = junctions.get(episode.route)
    return None if place is None else episode.completion_percent / 100.0 > place


def _signs(
    episodes: Sequence[Episode], rules: Rules, junctions: Mapping[str, float]
) -> Estimate:
    """Rate Traffic_Signs; 0.0.4 needs the junctions of failed routes only."""
    either = rules == "0.0.4"
    asked = [one for one in episodes if not (either and success(one))]
    # no rate if a junction that matters is unknown
    passed = {one.route: passes_the_junction(one, junctions) for one in asked}
    unknown = [route for route, each in passed.items() if each is None]
    if unknown:
        others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
        reason = f"where the junction is on {unknown[0]}{others} is not known"
        return Estimate.missing("%", reason, len(episodes))
    # successes and passed junctions, by the rules of the version
    good = sum(success(one) for one in episodes) + sum(map(bool, passed.values()))
    if either or not episodes:
        return _share(good, len(episodes))
    # half a success has no binomial interval
    rate = 100.0 * good / (2 * len(episodes))
    return Estimate(Measure(rate, "%"), None, None, len(episodes))


def _ran_a_sign(episode: Episode) -> bool:
    broken = (InfractionKind.STOP, InfractionKind.RED_LIGHT)
    return any(each.kind in broken for each in episode.infractions)


def _rate(episodes: Sequence[Episode]) -> Estimate:
    return _share(sum(success(one) for one in episodes), len(episodes))


def _share(good: int, n: int) -> Estimate:
    if n == 0:
        return Estimate.missing("%", "no such route was driven")
    low, high = binomial_interval(good, n)
    return Estimate(Measure(100.0 * good / n, "%"), low, high, n)


def _mean(rates: Mapping[str, Estimate], n: int) -> Estimate:
    for name, rate in rates.items():
        if rate.value is None:
            reason = f"{name}: {rate.measure.reason}"
            return Estimate.missing("%", reason, n)
    values = [rate.value for rate in rates.values() if rate.value is not None]
    return Estimate(Measure(fmean(values), "%"), None, None, n)
