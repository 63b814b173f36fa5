"""Observers compute one range per tensor from statistics.

To add an observer, write its class, then add it to the table at the end.
"""

import abc
import dataclasses
import math
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import FramesError, RecipeError
from me2e_compress.base.registry import Registry
from me2e_compress.calibration.statistics import Statistics
from me2e_compress.operators.kernels.kernel import BINS

__all__ = ["OBSERVERS", "QUANT_MAX", "Bounds", "Observer", "scale_of"]

# It drives no worse than max-min, and the plan moves less, from each of three
# recordings, by a rule that was written down before the drives (tag `road-1`)
DEFAULT_METHOD = "mse"

# Largest int8 magnitude in use: -128 is left out, so that the grid is symmetric.
QUANT_MAX = 127


def scale_of(low: float, high: float) -> np.float32:
    """Return the int8 step of a range: ``max(|low|, |high|) / 127``, zero point 0.

    A tensor that is always zero gets the step 1; a bound that is NaN or infinite is a
    FramesError.
    """
    if not (math.isfinite(low) and math.isfinite(high)):
        raise FramesError(f"a range of {low:g} to {high:g} has no int8 step")
    # Equation 3 of the paper divides `high - low` by `q_max - q_min`. That fits a range
    # centred on zero; with zero point 0 it would clip the upper half of a tensor that
    # is never negative (after a ReLU). So the range is first made symmetric, [-r, r]
    # with r = max(|low|, |high|), and the formula gives 2r / 254 = r / 127
    reach = max(abs(low), abs(high))
    step = np.float32(reach / QUANT_MAX)
    return step if step > 0 else np.float32(1)


# The low or the high bound of the range of every tensor: float32 [tensors].
Bounds: TypeAlias = npt.NDArray[np.float32]


@dataclasses.dataclass(frozen=True)
class Observer(abc.ABC):
    """Base of observers: derive a frozen dataclass, whose fields are the options.

    Class attributes:
        name: its name in recipes and on the command line.
        counts: whether it needs histograms.
    """

    name: ClassVar[str]
    counts: ClassVar[bool] = False

    @abc.abstractmethod
    def ranges(self, statistics: Statistics) -> tuple[Bounds, Bounds]:
        """Return the low and the high bound of every tensor's range.

        Both are finite and do not exceed the observed extremes, see :func:`within`.
        """


def within(statistics: Statistics, reach: Bounds) -> tuple[Bounds, Bounds]:
    """Clip the extremes of every tensor at plus and minus its reach."""
    lows, highs = statistics.lows.min(axis=0), statistics.highs.max(axis=0)
    low, high = np.maximum(lows, -reach), np.minimum(highs, reach)
    # If all observed values are beyond the reach, the range shrinks to the nearest one
    return np.minimum(low, highs), np.maximum(high, lows)


@dataclasses.dataclass(frozen=True)
class MaxMin(Observer):
    """Static max-min: the extremes over all frames, as in equation 3 of the paper.

    It differs from the moving average that other tools also call min-max.
    """

    name: ClassVar[str] = "max-min"

    def ranges(self, statistics: Statistics) -> tuple[Bounds, Bounds]:
        """Return the extremes over all frames."""
        return statistics.lows.min(axis=0), statistics.highs.max(axis=0)


# Number of magnitudes in each of the bins: int64 [bins].
Counts: TypeAlias = npt.NDArray[np.int64]

# Magnitudes of the int8 grid, 0 to 127: no tried threshold has fewer bins.
LEVELS = 128

# Bins between tried thresholds: 240 of them instead of 1,920.
_STRIDE = BINS // 256


@dataclasses.dataclass(frozen=True)
class HistogramObserver(Observer):
    """Base of observers that clip every tensor at an edge between two bins."""

    counts: ClassVar[bool] = True

    @abc.abstractmethod
    def edge(self, counts: Counts) -> int:
        """Return the number of bins of a histogram that stay in the range."""

    def ranges(self, statistics: Statistics) -> tuple[Bounds, Bounds]:
        """Clip every tensor at the edge of its histogram."""
        # A tensor without elements keeps all bins
        histograms = statistics.histograms()
        edges = [self.edge(row) if row.any() else BINS for row in histograms]
        reach = np.ldexp(np.array(edges, np.float64) / BINS, statistics.exponents)
        return within(statistics, reach.astype(np.float32))


@dataclasses.dataclass(frozen=True)
class Percentile(HistogramObserver):
    """The magnitude that ``percent`` of all elements of all frames do not exceed.

    Attributes:
        percent: above 0 and at most 100; the default is that of TensorRT's and
            onnxruntime's tools.
    """

    name: ClassVar[str] = "percentile"
    percent: float = 99.99

    def __post_init__(self) -> None:
        if not 0 < self.percent <= 100:  # NaN too
            raise RecipeError(
                f"{self.name}: percent must be above 0 and at most 100, found"
                f" {self.percent:g}"
            )

    def edge(self, counts: Counts) -> int:
        """Return the percentile, rounded up to the edge of a bin."""
        total = np.cumsum(counts)
        share = total[-1] * (self.percent / 100)
        return int(np.searchsorted(total, share)) + 1


@dataclasses.dataclass(frozen=True)
class MeanSquaredError(HistogramObserver):
    """The threshold whose int8 grid has the least mean squared error."""

    name: ClassVar[str] = "mse"

    def edge(self, counts: Counts) -> int:
        """Return the edge at which rounding and clipping cost least."""
        # In a tie it is the last bin in use
        top = int(np.flatnonzero(counts)[-1]) + 1
        tried = [top, *range(LEVELS, top, _STRIDE)]
        centres, noises = np.arange(BINS) + 0.5, list[float]()
        for edge in tried:
            # The summed squared error of a grid that ends there, in bins
            step = edge / QUANT_MAX
            rounded = np.minimum(np.rint(centres / step), QUANT_MAX) * step
            noises.append(float(counts @ np.square(centres - rounded)))
        best: int = tried[int(np.argmin(noises))]
        return best


OBSERVERS: Registry[Observer] = Registry(
    "calibration method",
    "me2e_compress.observers",
    RecipeError,
    {
        "max-min": f"{__name__}:MaxMin",
        "percentile": f"{__name__}:Percentile",
        "mse": f"{__name__}:MeanSquaredError",
    },
)
