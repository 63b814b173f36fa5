"""Bench2Drive's five abilities: which routes count as successes, and the rates.

A route counts under every ability that it tests; routes without a record are not
counted. For Traffic_Signs a route also counts that failed, but *passed the junction*:
the ego came more than 8 m into it and ran no stop sign or red light
(tools/ability_benchmark.py, branch 0.0.4).
"""

from collections.abc import Mapping, Sequence
from statistics import fmean

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


def ability_rates(episodes: Sequence[Episode]) -> dict[str, Estimate]:
    """Return the rate of each ability of a real run in percent, and their mean.

    A real run does not say where junctions are. Where that decides, the rate of
    Traffic_Signs is None, and so is the mean.
    """
    rates = {
        ability: _rate([one for one in episodes if ability in one.abilities])
        for ability in ABILITIES
    }
    unknown = [
        one.route
        for one in episodes
        if TRAFFIC_SIGNS in one.abilities and _hangs_on_the_junction(one)
    ]
    if unknown:
        others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
        reason = f"where the junction is on {unknown[0]}{others} is not known"
        n = sum(TRAFFIC_SIGNS in one.abilities for one in episodes)
        rates[TRAFFIC_SIGNS] = Estimate.missing("%", reason, n)
    return {**rates, MEAN: _mean(rates, len(episodes))}


def _hangs_on_the_junction(episode: Episode) -> bool:
    """Return whether a failed route counts if the ego passed its junction."""
    failed = not success(episode) and not _ran_a_sign(episode)
    return failed and episode.completion_percent > 0.0


def _ran_a_sign(episode: Episode) -> bool:
    broken = (InfractionKind.STOP, InfractionKind.RED_LIGHT)
    return any(each.kind in broken for each in episode.infractions)


def _rate(episodes: Sequence[Episode]) -> Estimate:
    n = len(episodes)
    if n == 0:
        return Estimate.missing("%", "no such route was driven")
    good = sum(success(one) for one in episodes)
    low, high = binomial_interval(good, n)
    return Estimate(Measure(100.0 * good / n, "%"), low, high, n)


def _mean(rates: Mapping[str, Estimate], n: int) -> Estimate:
    for name, rate in rates.items():
        if rate.value is None:
            reason = f"{name}: {rate.measure.reason}"
            return Estimate.missing("%", reason, n)
    values = [rate.value for rate in rates.values() if rate.value is not None]
    return Estimate(Measure(fmean(values), "%"), None, None, n)
