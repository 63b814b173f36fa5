"""Weights as int8, one scale a channel."""

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.observers import QUANT_MAX


def quantize_weight(
    weight: npt.NDArray[np.float32], axis: int | None
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32]]:
    """Round a weight to int8, symmetric, one scale an index along an axis, or one.

    ``scale = max|w| / 127`` over everything but the axis, ``q = round(w / scale)``,
    halves to the even neighbour, as QuantizeLinear rounds. A channel that is zero
    throughout gets scale 1.

    Args:
        weight: float32.
        axis: which axis is the channel's; None for one scale everywhere.

    Returns:
        int8 of the same shape, and float32 [channels], or [] without an axis.
    """
    others = tuple(each for each in range(weight.ndim) if each != axis)
    reach = np.abs(weight).max(axis=others, initial=0.0, keepdims=True)
    steps = np.asarray(reach / np.float32(QUANT_MAX), np.float32)
    steps[steps == 0] = 1
    integers = np.clip(np.rint(weight / steps), -QUANT_MAX, QUANT_MAX).astype(np.int8)
    return integers, steps.reshape(() if axis is None else -1)
