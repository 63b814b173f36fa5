"""A driver that sees nothing: constant speed along the centre of the route.

A route that it solves tests nothing, so it is not admitted.
"""

from dataclasses import dataclass, field
from typing import ClassVar

import numpy as np

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import (
    PLAN_SHAPE,
    PLAN_STEP_US,
    Observation,
    Plan,
    Policy,
    RouteInfo,
)
from me2e_compress.driving.policies import Driver
from me2e_compress.simulator.plane_geometry import RoutePath
from me2e_compress.simulator.scene import Ego
from models.driver.expert.privileged import scene_and_world
from models.driver.expert.reentry import beyond, reentry, slope_of

SPEEDS_MPS = (4.0, 8.0, 12.0)
"""Speeds at which the admission gate tries the blind driver."""
ACCELERATION_MPS2 = 3.0
"""Acceleration to its speed."""
REENTRY_S = 1.5


@dataclass
class Blind:
    """Follows the centre of the route at one speed, whatever is in the way.

    It is privileged in that it knows the route's centre line and its own pose.
    """

    speed_mps: float = 8.0
    needs_images: bool = field(default=False, init=False)
    privileged: bool = field(default=True, init=False)
    _at_m: float | None = field(default=None, init=False, repr=False)

    def reset(self, route: RouteInfo) -> None:
        """Forget the last position."""
        self._at_m = None

    def plan(self, observation: Observation) -> Plan:
        """Return waypoints [6, 2] of the route ahead; see `centre_plan`."""
        scene, world = scene_and_world(observation, "driver blind")
        ego, path = scene.ego, world.path
        self._at_m, _ = path.project(ego.x, ego.y, self._at_m)
        return centre_plan(ego, path, self._at_m, self.speed_mps)


def centre_plan(ego: Ego, path: RoutePath, near_m: float, speed_mps: float) -> Plan:
    """Return waypoints [6, 2] (m, ego frame) along the centre of a route.

    ``near_m`` is where the ego was last seen on the route; ``speed_mps`` is reached at
    3 m/s2 and kept.
    """
    s, lateral = path.project(ego.x, ego.y, near_m)
    times = (1 + np.arange(PLAN_SHAPE[0])) * (PLAN_STEP_US / 1e6)
    short = speed_mps - ego.speed_mps
    ramp_s = np.minimum(times, abs(short) / ACCELERATION_MPS2)
    lost = np.sign(short) * ACCELERATION_MPS2 * ramp_s**2 / 2
    travel = ego.speed_mps * ramp_s + lost + speed_mps * (times - ramp_s)
    length = np.array([max(6.0, REENTRY_S * speed_mps)])
    slope = slope_of(ego, path, s)
    offsets = reentry(travel[None], lateral, slope, np.zeros(1), length)[0]
    x, y, _ = beyond(path, s + travel, offsets)
    return ego.seen(x, y)


@dataclass(frozen=True)
class BlindDriver(Driver):
    """Follows the centre of the route at one speed, whatever stands there.

    Attributes:
        speed_mps: The speed in m/s; None for 8.

    Raises:
        EvaluationError: A speed that is not positive.
    """

    name: ClassVar[str] = "blind"
    speed_mps: float | None = None

    def __post_init__(self) -> None:
        if self.speed_mps is not None and not 0.0 < self.speed_mps < float("inf"):
            raise EvaluationError(f"blind: {self.speed_mps:g} is not a speed in m/s")

    def open(self) -> Policy:
        """Return the blind driver."""
        return Blind() if self.speed_mps is None else Blind(self.speed_mps)
