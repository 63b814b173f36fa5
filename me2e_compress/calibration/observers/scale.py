"""From a range to the int8 step."""

import math

import numpy as np

from me2e_compress.errors import FramesError

QUANT_MAX = 127
"""Largest int8 magnitude in use: -128 is left out, so that the grid is symmetric."""


def scale_of(low: float, high: float) -> np.float32:
    """Return the int8 step of a range: ``max(|low|, |high|) / 127``, zero point 0.

    Equation 3 of the paper divides ``high - low`` by ``q_max - q_min``. That fits a
    range centred on zero; with zero point 0 it would clip the upper half of a tensor
    that is never negative (what follows a ReLU). So the range is first made symmetric,
    [-r, r] with r = max(|low|, |high|), and the formula gives 2r / 254 = r / 127.

    A tensor that is zero throughout has no step of its own: it gets 1.

    Raises:
        FramesError: a bound is NaN or infinite.
    """
    if not (math.isfinite(low) and math.isfinite(high)):
        raise FramesError(f"a range of {low:g} to {high:g} has no int8 step")
    reach = max(abs(low), abs(high))
    step = np.float32(reach / QUANT_MAX)
    return step if step > 0 else np.float32(1)
