"""Input sources of the ego's motion, in SI units and the model's axes."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True)
class Speed(InputSource):
    """The speed, m/s: []."""

    name: ClassVar[str] = "speed"

    def value(self, seen: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(float(seen.observation.speed_mps))


@dataclass(frozen=True)
class Velocity(InputSource):
    """The speed as a vector along the vehicle, m/s: [2]."""

    name: ClassVar[str] = "velocity"

    def value(self, seen: Observed) -> Array:
        """Return float64 [2]."""
        return seen.turned([seen.observation.speed_mps, 0.0])


@dataclass(frozen=True)
class Acceleration(InputSource):
    """The acceleration, m/s2: [2], or [3].

    Attributes:
        vertical: Add the vertical component.
    """

    name: ClassVar[str] = "acceleration"
    vertical: bool = False

    def value(self, seen: Observed) -> Array:
        """Return float64 [2 or 3]."""
        forward, left, up = seen.observation.can_bus[10:13]
        level = seen.turned([forward, left])
        return np.append(level, up) if self.vertical else level


@dataclass(frozen=True)
class YawRate(InputSource):
    """The rate of turning, rad/s, counter-clockwise in right-handed axes: []."""

    name: ClassVar[str] = "yaw-rate"

    def value(self, seen: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(seen.angle(float(seen.observation.can_bus[15])))
