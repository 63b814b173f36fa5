"""Noise on the driven plan, so that the data shows how to return to the route."""

from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Self

import numpy as np

from me2e_compress.driving.contract import PLAN_SHAPE, Plan

BURST_S = (0.4, 1.5)
PAUSE_S = (0.9, 4.8)
"""Between two bursts; with `BURST_S` a quarter of the time is noise."""
DRIFT_M = 1.5
"""Largest sideways shift of the last waypoint."""
DRIFT_TRAVEL_M = 6.0
"""A plan that goes less far than this drifts less: who stands does not creep."""
TURN_RAD = float(np.deg2rad(8.0))
SPEED = (0.5, 1.3)
GROWTH = (1.0 + np.arange(PLAN_SHAPE[0])) / PLAN_SHAPE[0]


@dataclass(frozen=True)
class Bend:
    """What is done to a plan.

    Attributes:
        drift_m: Metres to the left at the last waypoint, growing with time.
        turn_rad: How far the plan is turned to the left.
        speed: What its length is multiplied by.
    """

    drift_m: float = 0.0
    turn_rad: float = 0.0
    speed: float = 1.0

    @classmethod
    def draw(cls, rng: np.random.Generator, strength: float) -> Self:
        """Drift, turn or change of speed, each as likely, uniform in its range."""
        kind, side = rng.integers(3), rng.uniform(-1.0, 1.0)
        if kind == 0:
            return cls(drift_m=strength * DRIFT_M * side)
        if kind == 1:
            return cls(turn_rad=strength * TURN_RAD * side)
        change = strength * (rng.uniform(*SPEED) - 1.0)
        return cls(speed=max(1.0 + change, 0.0))

    def apply(self, plan: Plan) -> Plan:
        """Return the bent plan; [6, 2] metres in the ego frame, as the given one."""
        cos, sin = np.cos(self.turn_rad), np.sin(self.turn_rad)
        turned = self.speed * plan @ np.array([[cos, sin], [-sin, cos]])
        share = min(float(np.hypot(*plan[-1])) / DRIFT_TRAVEL_M, 1.0)
        turned[:, 1] += self.drift_m * share * GROWTH
        return np.asarray(turned)


@dataclass(frozen=True)
class Burst:
    """A bend and when it is in force."""

    begin_us: int
    end_us: int
    bend: Bend


def bursts(rng: np.random.Generator, strength: float) -> Iterator[Burst]:
    """Yield bursts in order of time, without end."""
    at = 0.0
    while True:
        begin = at + rng.uniform(*PAUSE_S)
        at = begin + rng.uniform(*BURST_S)
        yield Burst(int(begin * 1e6), int(at * 1e6), Bend.draw(rng, strength))


@dataclass
class Perturbation:
    """The noise of one route.

    Args:
        rng: Where the noise comes from.
        strength: Scales it; 0 leaves every plan as it is.
    """

    rng: np.random.Generator
    strength: float
    _coming: Iterator[Burst] = field(init=False, repr=False)
    _burst: Burst = field(init=False, repr=False)

    def __post_init__(self) -> None:
        """Draw the first burst."""
        self._coming = bursts(self.rng, self.strength)
        self._burst = next(self._coming)

    def bent(self, plan: Plan, time_us: int) -> Plan:
        """Return what is driven at a time; times must not decrease."""
        while time_us >= self._burst.end_us:
            self._burst = next(self._coming)
        if self.strength == 0.0 or time_us < self._burst.begin_us:
            return plan
        return self._burst.bend.apply(plan)
