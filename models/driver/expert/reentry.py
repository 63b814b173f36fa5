"""How a plan returns to the centre of the route."""

import math

import numpy as np

from me2e_compress.simulator.bicycle import slip_of
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Ego

STEEPEST = 0.6
"""Largest slope (m of offset per m of route) that a re-entry starts from."""


def slope_of(ego: Ego, path: RoutePath, s_m: float) -> float:
    """Return the slope of the ego's course, metres to the left per metre of route."""
    course = ego.heading + slip_of(ego.steering_rad)
    away = course - float(path.value(path.headings, s_m))
    away = math.remainder(away, 2 * math.pi)
    return min(max(math.tan(min(max(away, -1.2), 1.2)), -STEEPEST), STEEPEST)


def reentry(
    travel_m: Floats, offset_m: float, slope: float, target_m: Floats, length_m: Floats
) -> Floats:
    """Return [K, T] lateral offsets of a cubic from (offset, slope) to (target, 0).

    Replanned at every step it is a damped feedback on offset e and slope e', since it
    starts with curvature -6 e / L^2 - 4 e' / L (damping 0.82). Starting flat, as if e'
    were 0, has no damping at all.

    Metres of route since now are [K, T], targets and lengths of the change [K], offsets
    metres left of the route.
    """
    u = np.clip(travel_m / length_m[:, None], 0.0, 1.0)
    moved = u * u * (3 - 2 * u)
    swing = u * (1 - u) ** 2 * (slope * length_m)[:, None]
    return offset_m + (target_m - offset_m)[:, None] * moved + swing


def beyond(path: RoutePath, s_m: Floats, lateral_m: Floats) -> tuple[Floats, ...]:
    """Return (x, y, heading) at arc lengths of a route extended straight."""
    x, y, heading = path.at(s_m, lateral_m)
    over = np.maximum(s_m - path.length_m, 0.0) + np.minimum(s_m, 0.0)
    return x + over * np.cos(heading), y + over * np.sin(heading), heading
