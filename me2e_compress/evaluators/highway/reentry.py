"""Re-entering a route: waypoints of somebody who wants to be on a line beside it."""

import math

import numpy as np

from me2e_compress.simulator.bicycle import slip_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Ego, RoutePath

STEEPEST = 0.6
"""Largest slope (m of offset per m of route) that a re-entry starts from."""


def slope_of(ego: Ego, path: RoutePath, s_m: float) -> float:
    """Metres to the left per metre of route that the ego gains on its course."""
    course = ego.heading + slip_of(ego.steering_rad)
    away = course - float(path.value(path.headings, s_m))
    away = math.remainder(away, 2 * math.pi)
    return min(max(math.tan(min(max(away, -1.2), 1.2)), -STEEPEST), STEEPEST)


def reentry(
    travel_m: Floats, offset_m: float, slope: float, target_m: Floats, length_m: Floats
) -> Floats:
    """Lateral offsets of a cubic from (offset, slope) to a flat (target, 0).

    Planned anew at every step it is a damped feedback on offset e and slope e', since
    it starts with curvature -6 e / L^2 - 4 e' / L (damping 0.82). Starting flat, as if
    e' were 0, has no damping at all.

    Args:
        travel_m: [K, T] metres of route since now.
        offset_m: Where the ego is, metres left of the route.
        slope: How it moves, see `slope_of`.
        target_m: [K] where it wants to be.
        length_m: [K] metres of route that the change takes.

    Returns:
        [K, T] metres left of the route.
    """
    u = np.clip(travel_m / length_m[:, None], 0.0, 1.0)
    moved = u * u * (3 - 2 * u)
    swing = u * (1 - u) ** 2 * (slope * length_m)[:, None]
    return offset_m + (target_m - offset_m)[:, None] * moved + swing


def beyond(path: RoutePath, s_m: Floats, lateral_m: Floats) -> tuple[Floats, ...]:
    """(x, y, heading) at arc lengths, the route extended straight at its end."""
    x, y, heading = path.at(s_m, lateral_m)
    over = np.maximum(s_m - path.length_m, 0.0) + np.minimum(s_m, 0.0)
    return x + over * np.cos(heading), y + over * np.sin(heading), heading


def in_ego_frame(x: Floats, y: Floats, ego: Ego) -> Floats:
    """[N, 2] points of the plane, x forward and y left of the ego."""
    cos, sin = math.cos(ego.heading), math.sin(ego.heading)
    dx, dy = x - ego.x, y - ego.y
    return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)
