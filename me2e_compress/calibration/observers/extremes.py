"""Ranges read off the smallest and largest element of every frame."""

import dataclasses
from typing import ClassVar

import numpy as np

from me2e_compress.calibration.observers.base import Bounds, Observer, check_option
from me2e_compress.calibration.statistics import Statistics


@dataclasses.dataclass(frozen=True)
class MaxMin(Observer):
    """Static max-min: the extremes over all frames, as equation 3 of the paper reads.

    Not the moving average that other tools call min-max too.
    """

    name: ClassVar[str] = "max-min"

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the extremes over all frames."""
        return seen.lows.min(axis=0), seen.highs.max(axis=0)


@dataclasses.dataclass(frozen=True)
class MovingAverage(Observer):
    """Exponential moving average of the extremes, in the order of the frames.

    ``range += weight * (frame - range)``, begun at the first frame. A rare extreme
    counts for little, and is clipped.

    Attributes:
        weight: of a new frame, above 0 and at most 1; the default is that of torch's
            ``MovingAverageMinMaxObserver``.

    Raises:
        RecipeError: another weight.
    """

    name: ClassVar[str] = "moving-average"
    weight: float = 0.01

    def __post_init__(self) -> None:
        """Check the weight."""
        check_option(self.name, "weight", self.weight, 1.0)

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the averages after the last frame."""
        return self._average(seen.lows), self._average(seen.highs)

    def _average(self, bounds: Bounds) -> Bounds:
        mean = bounds[0].astype(np.float64)
        for each in bounds[1:]:
            mean += self.weight * (each - mean)
        return np.asarray(mean, np.float32)
