"""Success rates of Bench2Drive's abilities, by the rules of its two tools.

Both count, for each ability, the successes among the evaluated routes that test it;
routes without a record are not counted. For Traffic_Signs a route also *passes the
junction* (J) if its completion exceeds (c + 8) / n, where n is the number of points of
its dense route and c the index of the first one on a junction, and if it ran no stop
sign or red light. With S for a success, over N routes (tools/ability_benchmark.py):

* 0.0.3 adds the two: sum(S + J) / 2 N;
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
    if any(each.kind in _BROKEN for each in episode.infractions):
        return False
    if episode.completion_percent <= 0.0:
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
        return Estimate(Measure(None, "%", reason), None, None, len(episodes))
    # successes and passed junctions, by the rules of the version
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
