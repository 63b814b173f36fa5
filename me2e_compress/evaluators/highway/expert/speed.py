"""How fast the route may be driven: limits, bends, and braking for both in time."""

import numpy as np

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import RoutePath

LATERAL_MPS2 = 2.2
"""Lateral acceleration in bends; the comfort bound of nuPlan is 4.89."""
EASE_MPS2 = 1.8
"""Braking ahead of a bend or a lower limit."""
SLOWEST_MPS = 2.5
"""No bend is too tight for this."""


def ceiling(path: RoutePath) -> Floats:
    """[N] highest speed (m/s) at every metre of a route, without any traffic."""
    window = np.full(5, 0.2)
    bends = np.convolve(np.pad(np.abs(path.curvature), 2, mode="edge"), window, "valid")
    in_bend = np.sqrt(LATERAL_MPS2 / np.maximum(bends, 1e-4))
    top = np.minimum(path.speed_limits_mps, np.maximum(in_bend, SLOWEST_MPS))
    for i in range(len(top) - 2, -1, -1):
        top[i] = min(top[i], np.sqrt(top[i + 1] ** 2 + 2 * EASE_MPS2))
    return top
