"""Ranges of so many times the root mean square."""

import dataclasses
from typing import ClassVar

import numpy as np

from me2e_compress.calibration.observers import Bounds, Observer, within
from me2e_compress.calibration.statistics import Statistics


@dataclasses.dataclass(frozen=True)
class Rms(Observer):
    """Clip every tensor at a multiple of its root mean square over all frames.

    Attributes:
        times: the multiple.
    """

    name: ClassVar[str] = "rms"
    times: float = 4.0

    def ranges(self, statistics: Statistics) -> tuple[Bounds, Bounds]:
        """Return bounds no wider than what was measured."""
        mean_squares = statistics.readings[:, :, 2].mean(axis=0)
        return within(statistics, np.float32(self.times) * np.sqrt(mean_squares))
