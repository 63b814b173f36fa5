"""Bench2Drive's abilities by the rules of its two tools, which differ in one of them.

Both count, for each ability, the successes among the evaluated routes that test it;
routes without a record are left out of the count. For Traffic_Signs a route also
*passes the junction* (J) if its completion exceeds (c + 8) / n, with n the points of
its dense route and c the first of them on a junction, and no stop sign or red light was
run. With S for a success, over N routes (tools/ability_benchmark.py):

* 0.0.3 adds the two up: sum(S + J) / 2 N;
* 0.0.4 takes either: sum(S or J) / N.
"""

from collections.abc import Mapping, Sequence
from statistics import fmean
from typing import Literal, get_args

from me2e_compress.metrics.abilities import ABILITIES, TRAFFIC_SIGNS
from me2e_compress.metrics.bench2drive import success
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.intervals import binomial_interval
from me2e_compress.metrics.measure import Estimate, Measure

Rules = Literal["0.0.3", "0.0.4"]
RULES: tuple[Rules, ...] = get_args(Rules)

MEAN = "mean"
_BROKEN = (InfractionKind.STOP, InfractionKind.RED_LIGHT)


def ability_rates(
    episodes: Sequence[Episode], rules: Rules, junctions: Mapping[str, float]
) -> dict[str, Estimate]:
    """Return the rate of each ability in percent, and their arithmetic mean.

    Args:
        episodes: Evaluated routes.
        rules: Of which tool.
        junctions: (c + 8) / n by route; where it decides and is not there, the rate
            of Traffic_Signs is None, and so is the mean.
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
    """Return J of a route; None where the place of its junction decides and is unknown.

    Args:
        episode: The route.
        junctions: (c + 8) / n by route.
    """
    if any(each.kind in _BROKEN for each in episode.infractions):
        return False
    if episode.completion_percent <= 0.0:
        return False
    place = junctions.get(episode.route)
    return None if place is None else episode.completion_percent / 100.0 > place


def _signs(
    episodes: Sequence[Episode], rules: Rules, junctions: Mapping[str, float]
) -> Estimate:
    """Count Traffic_Signs; 0.0.4 asks for the junction of failed routes alone."""
    either = rules == "0.0.4"
    asked = [one for one in episodes if not (either and success(one))]
    passed = {one.route: passes_the_junction(one, junctions) for one in asked}
    unknown = [route for route, each in passed.items() if each is None]
    if unknown:
        others = f" and {len(unknown) - 1} others" if len(unknown) > 1 else ""
        reason = f"where the junction is on {unknown[0]}{others} is not known"
        return Estimate(Measure(None, "%", reason), None, None, len(episodes))
    good = sum(success(one) for one in episodes)
    if either:
        return _share(good + sum(bool(each) for each in passed.values()), episodes)
    counted = good + sum(bool(each) for each in passed.values())
    if not episodes:
        return _share(0, episodes)
    # half a success has no binomial interval
    rate = 100.0 * counted / (2 * len(episodes))
    return Estimate(Measure(rate, "%"), None, None, len(episodes))


def _rate(episodes: Sequence[Episode]) -> Estimate:
    return _share(sum(success(one) for one in episodes), episodes)


def _share(good: int, episodes: Sequence[Episode]) -> Estimate:
    n = len(episodes)
    if n == 0:
        return Estimate(Measure(None, "%", "no such route was driven"), None, None, 0)
    low, high = binomial_interval(good, n)
    bounds = [None if bound is None else 100.0 * bound for bound in (low, high)]
    return Estimate(Measure(100.0 * good / n, "%"), bounds[0], bounds[1], n)


def _mean(rates: Mapping[str, Estimate], n: int) -> Estimate:
    for name, rate in rates.items():
        if rate.value is None:
            reason = f"{name}: {rate.measure.reason}"
            return Estimate(Measure(None, "%", reason), None, None, n)
    values = [rate.value for rate in rates.values() if rate.value is not None]
    return Estimate(Measure(fmean(values), "%"), None, None, n)
