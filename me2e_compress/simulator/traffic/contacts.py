"""Contacts of an ego that drives on after a collision."""

import math
from dataclasses import dataclass, field

import numpy as np
from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.traffic.bodies import EgoVehicle

SAME_US = 5_000_000
SAME_M = 5.0
"""A contact with the same actor within 5 s of the last, or with any within 5 m of the
last collision, is no other collision: CollisionTest in atomic_criteria.py."""
DEEPER_M = 1e-3


@dataclass
class Contacts:
    """Which contacts count, and what they do to the ego."""

    _last_us: dict[int, int] = field(default_factory=dict)
    _place: Floats | None = None
    _position: Floats = field(default_factory=lambda: np.zeros(2))
    _heading: float = 0.0

    def before(self, ego: EgoVehicle) -> None:
        """Remember where the ego is before it moves."""
        self._position, self._heading = ego.position.copy(), float(ego.heading)

    def resist(self, ego: EgoVehicle, body: RoadObject) -> None:
        """Put the ego back if it moved farther into a body; then it stands."""
        now = depth(ego.position, ego.heading, ego, body)
        then = depth(self._position, self._heading, ego, body)
        if then > 0.0 and now > then + DEEPER_M:
            ego.position, ego.heading = self._position.copy(), self._heading
            ego.speed = 0.0

    def counts(self, time_us: int, ego: EgoVehicle, body: int) -> bool:
        """Return whether a contact is a collision of its own, and remember it."""
        last = self._last_us.get(body)
        self._last_us[body] = time_us
        place = self._place
        near = place is not None and np.hypot(*(ego.position - place)) < SAME_M
        if near or (last is not None and time_us - last < SAME_US):
            return False
        self._place = ego.position.copy()
        return True


def depth(place: Floats, heading: float, ego: EgoVehicle, body: RoadObject) -> float:
    """Return how deep (m) a body is in the ego at a pose; 0 or less if they are apart.

    It is the least overlap along the axes of both rectangles.
    """
    dx, dy = (float(value) for value in body.position - place)
    turn = float(body.heading - heading)
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    least = math.inf
    for at, one, other in ((heading, ego, body), (float(body.heading), body, ego)):
        ch, sh = math.cos(at), math.sin(at)
        along, across = abs(dx * ch + dy * sh), abs(dy * ch - dx * sh)
        least = min(
            least,
            (one.LENGTH + other.LENGTH * c + other.WIDTH * s) / 2 - along,
            (one.WIDTH + other.LENGTH * s + other.WIDTH * c) / 2 - across,
        )
    return least
