"""95 % intervals of means over routes, each stated as what it is.

Routes of one scenario type are alike (``benchmarks.bench_intervals`` says how much), so
there are two questions and two intervals:

* over *these types*: other routes of the same types might have been drawn. Routes are
  resampled within each type;
* over *types drawn anew*: other types might have been. Whole types are resampled, with
  all of their routes. Wider, and the one to quote for roads that are not in the set.

Both are percentile bootstraps that draw one fewer than there are (of a type's routes,
of the types), so that few routes a type do not make the interval too narrow (McCarthy
and Snowden 1985). Where nothing differed, resampling would promise a width of zero:
then the interval is that of the largest share of routes that could differ unseen.
"""

import functools
from collections.abc import Callable, Sequence
from statistics import fmean

import numpy as np
import numpy.typing as npt

from me2e_compress.metrics.measure import Estimate, Measure

CONFIDENCE = 0.95
RESAMPLES = 4_000
TRIALS = 20_000
"""Draws for a p-value: thirty tests corrected by Holm ask for small ones."""

Floats = npt.NDArray[np.float64]
Interval = tuple[float | None, float | None]
Bounds = tuple[float, float]
"""Smallest and largest value that a route can have."""


def mean_estimate(
    values: Sequence[float],
    types: Sequence[str],
    unit: str,
    seed: int = 0,
    bounds: Bounds | None = None,
) -> Estimate:
    """Return a mean over routes with both intervals.

    Args:
        values: One a route, at least one.
        types: The scenario type of each.
        unit: Of the values.
        seed: The same seed gives the same intervals.
        bounds: Of the values; None where they have none, and then routes that are all
            equal give no interval.
    """
    observed = np.array(values, np.float64)

    def mean(weights: Floats) -> Floats:
        return np.asarray(weights @ observed / weights.sum(axis=1))

    here, anew = intervals(mean, types, seed, fmean(values), bounds)
    return Estimate(Measure(fmean(values), unit), *here, len(values), *anew)


def intervals(
    statistic: Callable[[Floats], Floats],
    types: Sequence[str],
    seed: int,
    value: float,
    bounds: Bounds | None = None,
) -> tuple[Interval, Interval]:
    """Return the intervals of any statistic: over these types, over types drawn anew.

    Args:
        statistic: Takes weights of the routes [resamples, routes], returns [resamples].
        types: The scenario type of each route.
        seed: The same seed gives the same intervals.
        value: What the statistic is of the routes as they are.
        bounds: Smallest and largest value of a route, if there are any.
    """
    if len(types) < 2:
        return (None, None), (None, None)
    within, anew = _weights(tuple(types), seed)
    here = _middle(statistic(within))
    if _is_a_point(here):
        here = unseen_interval(value, len(types), bounds)
    kinds = len(set(types))
    if kinds < 2:
        return here, (None, None)
    over_types = _middle(statistic(anew))
    if _is_a_point(over_types):
        over_types = unseen_interval(value, kinds, bounds)
    return here, over_types


def drawn_anew(
    rows: Floats, types: Sequence[str], of_sums: Callable[[Floats], Floats], seed: int
) -> Floats:
    """Return a statistic of `TRIALS` sets of types drawn anew, as `intervals` draws.

    Of fewer than two types there are none.

    Args:
        rows: Numbers of each route [routes, k].
        types: The scenario type of each route.
        of_sums: Takes sums over the drawn routes [trials, k], returns [trials].
        seed: The same seed gives the same draws.
    """
    names, type_of = np.unique(np.array(types, str), return_inverse=True)
    if len(names) < 2:
        return np.zeros(0)
    sums = np.zeros((len(names), rows.shape[1]))
    np.add.at(sums, type_of, rows)
    weights = _drawn(np.random.default_rng(seed), len(names), TRIALS)
    return np.asarray(of_sums(weights @ sums))


def p_value(draws: Floats, edge: float) -> float:
    """Return the two-sided p-value of an edge: below 0.05 as the interval excludes it.

    It is at least 2 / (draws + 1). Draws that all are equal say nothing of what was not
    seen: 1.
    """
    if not len(draws) or _is_a_point((float(draws.min()), float(draws.max()))):
        return 1.0
    beyond = min(int((draws <= edge).sum()), int((draws >= edge).sum()))
    return min(1.0, 2.0 * (1 + beyond) / (len(draws) + 1))


def unseen_share(n: int) -> float:
    """Return the largest share that n draws without a hit leave open, with 95 %.

    Exact (1 - 0.05 ** (1 / n)); the rule of three says 3 / n.
    """
    return float(1.0 - (1.0 - CONFIDENCE) ** (1.0 / n))


def unseen_interval(value: float, n: int, bounds: Bounds | None) -> Interval:
    """Return the interval of a mean whose n values all are equal.

    At most `unseen_share` of all routes have another value, at most at the bounds.
    """
    if bounds is None:
        return None, None
    share = unseen_share(n)
    low, high = bounds
    return value - share * (value - low), value + share * (high - value)


def binomial_interval(successes: int, n: int) -> Interval:
    """Return the exact (Clopper-Pearson) interval of a rate, in percent.

    As if routes were independent of each other.
    """
    from scipy.stats import binomtest  # takes a second to import

    if n == 0:
        return None, None
    interval = binomtest(successes, n).proportion_ci(CONFIDENCE, method="exact")
    return 100.0 * float(interval.low), 100.0 * float(interval.high)


@functools.lru_cache(maxsize=2)  # a page asks of the same routes hundreds of times
def _weights(types: tuple[str, ...], seed: int) -> tuple[Floats, Floats]:
    """Return two [resamples, routes] weights: drawn within types, and types anew.

    Types with one route are one stratum together.
    """
    names, type_of, sizes = np.unique(
        np.array(types, str), return_inverse=True, return_counts=True
    )
    stratum = np.where(sizes[type_of] == 1, -1, type_of)
    random, within = np.random.default_rng(seed), np.zeros((RESAMPLES, len(stratum)))
    for name in np.unique(stratum):
        members = np.flatnonzero(stratum == name)
        within[:, members] = _drawn(random, len(members))
    anew = _drawn(np.random.default_rng(seed), len(names))[:, type_of]
    within.setflags(write=False)
    anew.setflags(write=False)
    return within, anew


def _drawn(
    random: np.random.Generator, size: int, resamples: int = RESAMPLES
) -> Floats:
    """Return [resamples, size] how often each was drawn, scaled to a sum of size."""
    draws = max(size - 1, 1)
    picked = random.integers(size, size=(resamples, draws))
    picked += size * np.arange(resamples)[:, None]
    counts = np.bincount(picked.ravel(), minlength=resamples * size)
    return counts.reshape(resamples, size).astype(np.float64) * (size / draws)


def _middle(values: Floats) -> Interval:
    tail = 50.0 * (1.0 - CONFIDENCE)
    low, high = np.percentile(values, [tail, 100.0 - tail])
    return float(low), float(high)


def _is_a_point(interval: Interval) -> bool:
    low, high = interval
    if low is None or high is None:
        return False
    return high - low <= 1e-9 * max(abs(low), abs(high), 1e-9)
