"""Weights as int8, one scale a channel."""

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.observers import QUANT_MAX


def quantize_weight(
    weight: npt.NDArray[np.float32], axis: int
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32]]:
    """Round a weight to int8, symmetric, one scale for each index along an axis.

    ``scale = max|w| / 127`` over everything but the axis, ``q = round(w / scale)``,
    halves to the even neighbour, as QuantizeLinear rounds. A channel that is zero
    throughout gets scale 1.

    Args:
        weight: float32, of rank 2 or more.
        axis: which axis is the channel's.

    Returns:
        int8 of the same shape, and float32 [channels].
    """
    others = tuple(each for each in range(weight.ndim) if each != axis)
    reach = np.abs(weight).max(axis=others, initial=0.0)
    scales = (reach / np.float32(QUANT_MAX)).astype(np.float32)
    scales[scales == 0] = 1
    shape = [1] * weight.ndim
    shape[axis] = -1
    steps = weight / scales.reshape(shape)
    return np.clip(np.rint(steps), -QUANT_MAX, QUANT_MAX).astype(np.int8), scales
