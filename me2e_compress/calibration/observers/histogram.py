"""Observers that use histograms of magnitudes, and may clip rare values."""

import abc
import dataclasses
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.observers.base import (
    QUANT_MAX,
    Bounds,
    Observer,
    check_option,
    within,
)
from me2e_compress.calibration.statistics import BINS, Statistics

Counts: TypeAlias = npt.NDArray[np.int64]
"""Number of magnitudes in each of the bins: int64 [bins]."""

LEVELS = 128
"""Magnitudes of the int8 grid, 0 to 127: no tried threshold has fewer bins."""

_STRIDE = BINS // 256
"""Bins between tried thresholds: 240 of them instead of 1,920."""


@dataclasses.dataclass(frozen=True)
class HistogramObserver(Observer):
    """Base of observers that clip every tensor at an edge between two bins."""

    counts: ClassVar[bool] = True

    @abc.abstractmethod
    def edge(self, counts: Counts) -> int:
        """Return the number of bins of a histogram that stay in the range."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Clip every tensor at the edge of its histogram."""
        # A tensor without elements keeps all bins
        edges = [self.edge(each) if each.any() else BINS for each in seen.counted()]
        reach = np.ldexp(np.array(edges, np.float64) / BINS, seen.exponents)
        return within(seen, reach.astype(np.float32))


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
        check_option(self.name, "percent", self.percent, 100.0)

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
        """Return the edge at which rounding and clipping cost least.

        In a tie it is the last bin in use.
        """
        top = int(np.flatnonzero(counts)[-1]) + 1
        tried = [top, *range(LEVELS, top, _STRIDE)]
        best: int = tried[int(np.argmin([_noise(counts, edge) for edge in tried]))]
        return best


def _noise(counts: Counts, edge: int) -> float:
    """Return the summed squared error of a grid that ends at an edge, in bins."""
    centres = np.arange(BINS) + 0.5
    step = edge / QUANT_MAX
    rounded = np.minimum(np.rint(centres / step), QUANT_MAX) * step
    return float(counts @ np.square(centres - rounded))
