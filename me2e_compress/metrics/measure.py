"""A value with its unit, or the reason why it has none; and its 95 % intervals.

Routes of one scenario type are alike (``benchmarks.measure.intervals`` says how much),
so there are two questions and two intervals of a mean over routes:

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
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from statistics import fmean

import numpy as np
import numpy.typing as npt


def too_few(percent: float, count: int) -> str:
    """Say why there are too few samples for a percentile; empty if there are enough.

    At least one sample must lie beyond it, n (1 - q) >= 1. With fewer, the percentile
    (the inverted distribution function, type 1 of Hyndman and Fan 1996) is just the
    maximum. ``count`` are measured samples: of a trace that latencies are drawn from,
    its length.
    """
    # 100 / (100 - 99.9) is a little more than 1000 in floating point
    needed = math.ceil(round(100.0 / (100.0 - percent), 6))
    return "" if count >= needed else f"needs {needed:,} samples, has {count:,}"


def percentile(samples: Sequence[int], percent: float) -> int:
    """Return the smallest sample that so many percent do not exceed."""
    # in whole numbers: 0.999 * 1000 is 999.0000000000001 in floating point
    rank = -(-len(samples) * round(10 * percent) // 1000)
    return sorted(samples)[rank - 1]


@dataclass(frozen=True, slots=True)
class Measure:
    """A value and its unit; None means it could not be measured, never zero.

    Raises:
        ValueError: There is neither a finite value nor a reason, or both.
    """

    value: float | None
    unit: str
    reason: str = ""

    def __post_init__(self) -> None:
        if self.value is not None and not math.isfinite(self.value):
            raise ValueError(f"a measure must be finite, found {self.value}")
        if (self.value is None) != bool(self.reason):
            raise ValueError("a measure has either a value or a reason for having none")

    def to_json(self) -> dict[str, float | str | None]:
        """Return value, unit and reason."""
        reason = self.reason or None
        return {"value": self.value, "unit": self.unit, "reason": reason}


@dataclass(frozen=True, slots=True)
class Estimate:
    """A mean over n routes with its 95 % intervals, None if n is too small."""

    measure: Measure
    low: float | None  # the interval over these scenario types
    high: float | None
    n: int
    anew_low: float | None = None  # the wider one over types drawn anew
    anew_high: float | None = None

    @classmethod
    def missing(cls, unit: str, reason: str, n: int = 0) -> "Estimate":
        """Return no mean, and the reason why there is none."""
        return cls(Measure(None, unit, reason), None, None, n)

    @property
    def value(self) -> float | None:
        """The mean itself."""
        return self.measure.value

    @property
    def sign(self) -> int:
        """Sign of a difference that is certain as printed, to a tenth; otherwise 0."""
        if self.low is not None and round(self.low, 1) > 0.0:
            return 1
        return -1 if self.high is not None and round(self.high, 1) < 0.0 else 0

    def to_json(self) -> dict[str, float | int | str | None]:
        """Return a flat object of all fields."""
        value, named = self.measure.to_json(), ("low", "high", "anew_low", "anew_high")
        ends = {name: getattr(self, name) for name in (*named, "n")}
        return {"value": value.pop("value"), **ends, **value}


CONFIDENCE = 0.95
RESAMPLES = 4_000
# Of fewer types, drawing them anew gives intervals that are too narrow, often narrower
# than those over these types: there is none
FEWEST_TYPES = 8
Floats = npt.NDArray[np.float64]
Interval = tuple[float | None, float | None]
Bounds = tuple[float, float]  # smallest and largest value that a route can have


def mean_estimate(
    values: Sequence[float],
    types: Sequence[str],
    unit: str,
    seed: int = 0,
    bounds: Bounds | None = None,
) -> Estimate:
    """Return a mean over routes with both intervals.

    There is one value a route, at least one, and a scenario type. The same seed gives
    the same intervals. Values without bounds that all are equal have no interval.
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

    The statistic takes weights of the routes [resamples, routes] and returns
    [resamples]; ``value`` is what it is of the routes as they are. See `mean_estimate`.
    """

    def middle(values: Floats, n: int) -> Interval:
        # Where nothing differed, the interval is that of what could differ unseen
        tail = 50.0 * (1.0 - CONFIDENCE)
        low, high = map(float, np.percentile(values, [tail, 100.0 - tail]))
        same = is_a_point((low, high))
        return unseen_interval(value, n, bounds) if same else (low, high)

    kinds = len(set(types))
    if len(types) < 2:
        return (None, None), (None, None)
    within, anew = _weights(tuple(types), seed)
    here = middle(statistic(within), len(types))
    if kinds < FEWEST_TYPES:
        return here, (None, None)
    return here, middle(statistic(anew), kinds)


def unseen_share(n: int) -> float:
    """Return the largest share that n draws without a hit leave open, with 95 %."""
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
    """Return the exact (Clopper-Pearson) interval of a rate, in percent."""
    from scipy.stats import binomtest  # takes a second to import

    if n == 0:
        return None, None
    interval = binomtest(successes, n).proportion_ci(CONFIDENCE, method="exact")
    return 100.0 * float(interval.low), 100.0 * float(interval.high)


@functools.lru_cache(maxsize=2)  # a page asks of the same routes hundreds of times
def _weights(types: tuple[str, ...], seed: int) -> tuple[Floats, Floats]:
    """Return two [resamples, routes] weights: drawn within types, and types anew."""
    names, type_of, sizes = np.unique(
        np.array(types, str), return_inverse=True, return_counts=True
    )
    # Resample the routes of each stratum, then whole types
    stratum = np.where(sizes[type_of] == 1, -1, type_of)
    random, within = np.random.default_rng(seed), np.zeros((RESAMPLES, len(stratum)))
    for name in np.unique(stratum):
        members = np.flatnonzero(stratum == name)
        within[:, members] = draw_weights(random, len(members))
    anew = draw_weights(np.random.default_rng(seed), len(names))[:, type_of]
    within.setflags(write=False)
    anew.setflags(write=False)
    return within, anew


def draw_weights(
    random: np.random.Generator, size: int, resamples: int = RESAMPLES
) -> Floats:
    """Return [resamples, size] how often each was drawn, scaled to a sum of size."""
    # Count the draws of every resample at once: its own range of bins
    draws = max(size - 1, 1)
    picked = random.integers(size, size=(resamples, draws))
    picked += size * np.arange(resamples)[:, None]
    counts = np.bincount(picked.ravel(), minlength=resamples * size)
    return counts.reshape(resamples, size).astype(np.float64) * (size / draws)


def is_a_point(interval: tuple[float, float]) -> bool:
    """Return whether both ends are equal, to nine digits."""
    low, high = interval
    return high - low <= 1e-9 * max(abs(low), abs(high), 1e-9)
