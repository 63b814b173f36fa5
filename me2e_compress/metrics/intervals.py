"""Confidence intervals (95 %) of means and rates over routes."""

from collections.abc import Callable, Sequence

import numpy as np
import numpy.typing as npt

CONFIDENCE = 0.95
RESAMPLES = 4_000

Floats = npt.NDArray[np.float64]
Interval = tuple[float | None, float | None]


def bootstrap_interval(values: Sequence[float], seed: int = 0) -> Interval:
    """Return the percentile bootstrap interval of a mean; two values are needed.

    Args:
        values: One a route.
        seed: The same seed gives the same interval.
    """
    observed = np.array(values, np.float64)

    def mean(picked: npt.NDArray[np.int64]) -> Floats:
        return np.asarray(observed[picked].mean(axis=-1))

    return resampled_interval(mean, len(values), seed)


def paired_interval(
    values: Sequence[float], reference: Sequence[float], seed: int = 0
) -> Interval:
    """Return the interval of the mean difference of two drivers on the same routes.

    Routes are drawn, not drivers: what makes a route hard for both cancels out, so
    the interval is narrower than the two of the means suggest.

    Args:
        values: One a route.
        reference: The other driver's, in the same order of routes.
        seed: The same seed gives the same interval.
    """
    gaps = [one - other for one, other in zip(values, reference, strict=True)]
    return bootstrap_interval(gaps, seed)


def resampled_interval(
    statistic: Callable[[npt.NDArray[np.int64]], Floats], routes: int, seed: int = 0
) -> Interval:
    """Return the interval of any statistic of routes drawn with replacement.

    Args:
        statistic: Takes indices [resamples, routes], returns [resamples].
        routes: How many routes there are; fewer than two give no interval.
        seed: The same seed gives the same interval.
    """
    from scipy.stats import bootstrap  # takes a second to import

    if routes < 2:
        return None, None
    interval = bootstrap(
        (np.arange(routes),),
        lambda picked, axis: statistic(picked.reshape(-1, routes)).reshape(
            picked.shape[:-1]
        ),
        n_resamples=RESAMPLES,
        batch=500,
        confidence_level=CONFIDENCE,
        method="percentile",
        vectorized=True,
        rng=np.random.default_rng(seed),
    ).confidence_interval
    return float(interval.low), float(interval.high)


def binomial_interval(successes: int, n: int) -> Interval:
    """Return the exact (Clopper-Pearson) interval of a rate, as a share."""
    from scipy.stats import binomtest  # takes a second to import

    if n == 0:
        return None, None
    interval = binomtest(successes, n).proportion_ci(CONFIDENCE, method="exact")
    return float(interval.low), float(interval.high)
