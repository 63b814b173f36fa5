"""Input sources of time."""

from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.runtime.frames import Array

MICROSECONDS = 1_000_000
"""Microseconds in a second."""


@dataclass(frozen=True)
class Timestamp(InputSource):
    """Time since the route began: [].

    Attributes:
        unit: Seconds, or whole microseconds (nuScenes').
    """

    name: ClassVar[str] = "timestamp"
    unit: Literal["s", "us"] = "s"

    def value(self, seen: Observed) -> Array:
        """Return float64 [], or int64 []."""
        time_us = seen.observation.time_us
        if self.unit == "us":
            return np.asarray(time_us, np.int64)
        return np.asarray(time_us / MICROSECONDS)


@dataclass(frozen=True)
class UsePrevious(InputSource):
    """0 at the first decision of a route, then 1 (UniAD's ``use_prev_bev``): []."""

    name: ClassVar[str] = "use-previous"

    def value(self, seen: Observed) -> Array:
        """Return int64 []."""
        return np.asarray(int(seen.track.decisions > 1), np.int64)
