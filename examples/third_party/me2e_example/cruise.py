"""A policy that holds its lane's direction and one speed."""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from me2e_compress.driving.contract import (
    PLAN_SHAPE,
    PLAN_STEP_US,
    Observation,
    Plan,
    Policy,
    RouteInfo,
)
from me2e_compress.driving.policies import Driver


@dataclass(frozen=True)
class Cruise(Driver):
    """Straight ahead at one speed, whatever there is.

    Attributes:
        speed_mps: the speed in m/s.
    """

    name: ClassVar[str] = "cruise"
    speed_mps: float = 6.0

    def open(self) -> Policy:
        """Return the policy."""
        return CruisePolicy(self.speed_mps)


@dataclass
class CruisePolicy:
    """Six waypoints straight ahead; it needs neither cameras nor the world."""

    speed_mps: float
    needs_images: bool = field(default=False, init=False)
    privileged: bool = field(default=False, init=False)

    def reset(self, route: RouteInfo) -> None:
        """Nothing is remembered from one route to the next."""

    def plan(self, observation: Observation) -> Plan:
        """Return waypoints [6, 2], metres in the ego frame, every 0.5 s."""
        seconds = (1 + np.arange(PLAN_SHAPE[0])) * (PLAN_STEP_US / 1e6)
        return np.stack([seconds * self.speed_mps, np.zeros_like(seconds)], axis=1)
