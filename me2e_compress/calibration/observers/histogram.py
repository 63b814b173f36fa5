"""Observers that use histograms of magnitudes, and may clip rare values."""

import dataclasses
from collections.abc import Callable
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
"""Magnitudes of the int8 grid, 0 to 127; TensorRT's entropy method uses as many (S.
Migacz, 8-bit inference with TensorRT, GTC 2017)."""

_STRIDE = BINS // 256
"""Bins between tried thresholds: 240 of them instead of 1,920."""


@dataclasses.dataclass(frozen=True)
class Percentile(Observer):
    """The magnitude that ``percent`` of all elements of all frames do not exceed.

    Attributes:
        percent: above 0 and at most 100; the default is that of TensorRT's and
            onnxruntime's tools.
    """

    name: ClassVar[str] = "percentile"
    counts: ClassVar[bool] = True
    percent: float = 99.99

    def __post_init__(self) -> None:
        check_option(self.name, "percent", self.percent, 100.0)

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Clip every tensor at its percentile, rounded up to the edge of a bin."""
        return within(seen, _reaches(seen, self._edge))

    def _edge(self, counts: Counts) -> int:
        total = np.cumsum(counts)
        share = total[-1] * (self.percent / 100)
        return int(np.searchsorted(total, share)) + 1


@dataclasses.dataclass(frozen=True)
class MeanSquaredError(Observer):
    """The threshold whose int8 grid has the least mean squared error."""

    name: ClassVar[str] = "mse"
    counts: ClassVar[bool] = True

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Clip every tensor where rounding and clipping cost least."""
        return within(seen, _reaches(seen, lambda counts: _best(counts, _noise)))


@dataclasses.dataclass(frozen=True)
class Entropy(Observer):
    """The threshold whose int8 grid keeps the distribution best: least KL divergence.

    Migacz's method. Zero is on every grid, so the bin of zeros is set to its
    neighbour's count: otherwise the zeros after a ReLU would dominate.
    """

    name: ClassVar[str] = "entropy"
    counts: ClassVar[bool] = True

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Clip every tensor where the KL divergence is least."""
        return within(seen, _reaches(seen, lambda counts: _best(counts, _divergence)))


def _reaches(seen: Statistics, edge: Callable[[Counts], int]) -> Bounds:
    """Convert the chosen bin edge of every histogram to a magnitude."""
    edges = [edge(counts) if counts.any() else BINS for counts in seen.counted()]
    return np.ldexp(np.array(edges, np.float64) / BINS, seen.exponents).astype(
        np.float32
    )


def _best(counts: Counts, cost: Callable[[Counts, int], float]) -> int:
    """Return the cheapest threshold; in a tie, the last bin in use."""
    top = int(np.flatnonzero(counts)[-1]) + 1
    tried = [top, *range(LEVELS, top, _STRIDE)]
    costs = [cost(counts, edge) for edge in tried]
    best: int = tried[int(np.argmin(costs))]
    return best


def _noise(counts: Counts, edge: int) -> float:
    """Return the summed squared error of a grid that ends at an edge, in bins."""
    centres = np.arange(BINS) + 0.5
    step = edge / QUANT_MAX
    rounded = np.minimum(np.rint(centres / step), QUANT_MAX) * step
    return float(counts @ np.square(centres - rounded))


def _divergence(counts: Counts, edge: int) -> float:
    """Return the KL divergence between the bins below an edge and their grid of levels.

    Elements beyond the edge count in the last bin before it. A level spreads its
    elements evenly over those of its bins that are not empty.
    """
    # Zero is on every grid: its bin must not dominate.
    kept = counts[:edge].astype(np.float64)
    kept[0] = kept[1] if edge > 1 else kept[0]
    clipped = kept.copy()
    clipped[-1] += counts[edge:].sum()
    if not kept.any():
        return np.inf
    # Spread each level's elements over its bins in use.
    level = np.arange(edge) * LEVELS // edge
    filled = clipped > 0
    held = np.bincount(level, kept, LEVELS)
    bins = np.bincount(level, filled, LEVELS)
    spread = np.where(filled, (held / np.maximum(bins, 1))[level], 0)
    p, q = clipped / clipped.sum(), spread / spread.sum()
    # A bin without any mass left makes the divergence infinite.
    lost = (p > 0) & (q == 0)
    if lost.any():
        return np.inf
    used = p > 0
    return float(np.sum(p[used] * np.log(p[used] / q[used])))
