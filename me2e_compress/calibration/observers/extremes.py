"""Ranges read off the smallest and largest element of every frame."""

import dataclasses
from typing import ClassVar

import numpy as np

from me2e_compress.calibration.observers.base import Ends
from me2e_compress.calibration.statistics import Statistics


@dataclasses.dataclass(frozen=True)
class MaxMin:
    """Static max-min: the extremes over all frames, as equation 3 of the paper reads.

    Not the moving average that other tools call min-max too.
    """

    name: ClassVar[str] = "max-min"
    counts: ClassVar[bool] = False

    @property
    def text(self) -> str:
        """The method as it is named."""
        return self.name

    def ranges(self, seen: Statistics) -> tuple[Ends, Ends]:
        """Give the extremes over all frames."""
        return seen.lows.min(axis=0), seen.highs.max(axis=0)


@dataclasses.dataclass(frozen=True)
class MovingAverage:
    """Exponential moving average of the extremes, in the order of the frames.

    ``range += weight * (frame - range)``, begun at the first frame. A rare extreme
    counts for little, and is clipped.

    Attributes:
        weight: of a new frame, above 0 and at most 1; the default is that of torch's
            ``MovingAverageMinMaxObserver``.
    """

    name: ClassVar[str] = "moving-average"
    counts: ClassVar[bool] = False
    weight: float = 0.01

    @property
    def text(self) -> str:
        """The method with its weight."""
        return f"{self.name}:{self.weight:g}"

    def ranges(self, seen: Statistics) -> tuple[Ends, Ends]:
        """Give the averages after the last frame."""
        return self._average(seen.lows), self._average(seen.highs)

    def _average(self, ends: Ends) -> Ends:
        mean = ends[0].astype(np.float64)
        for each in ends[1:]:
            mean += self.weight * (each - mean)
        return np.asarray(mean, np.float32)
