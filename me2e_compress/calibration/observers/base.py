"""The interface of observers, the int8 step, and the max-min observers."""

import abc
import dataclasses
import math
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.statistics import Statistics
from me2e_compress.errors import FramesError, RecipeError

QUANT_MAX = 127
"""Largest int8 magnitude in use: -128 is left out, so that the grid is symmetric."""


def scale_of(low: float, high: float) -> np.float32:
    """Return the int8 step of a range: ``max(|low|, |high|) / 127``, zero point 0.

    Equation 3 of the paper divides ``high - low`` by ``q_max - q_min``. That fits a
    range centred on zero; with zero point 0 it would clip the upper half of a tensor
    that is never negative (after a ReLU). So the range is first made symmetric, [-r, r]
    with r = max(|low|, |high|), and the formula gives 2r / 254 = r / 127. A tensor that
    is always zero gets the step 1.

    Raises:
        FramesError: a bound is NaN or infinite.
    """
    if not (math.isfinite(low) and math.isfinite(high)):
        raise FramesError(f"a range of {low:g} to {high:g} has no int8 step")
    reach = max(abs(low), abs(high))
    step = np.float32(reach / QUANT_MAX)
    return step if step > 0 else np.float32(1)


Bounds: TypeAlias = npt.NDArray[np.float32]
"""The low or the high bound of the range of every tensor: float32 [tensors]."""


@dataclasses.dataclass(frozen=True)
class Observer(abc.ABC):
    """Base of observers: derive a frozen dataclass, whose fields are the options.

    Class attributes:
        name: its name in recipes and on the command line.
        counts: whether it needs histograms, i.e. a second pass over the frames.
    """

    name: ClassVar[str]
    counts: ClassVar[bool] = False

    @abc.abstractmethod
    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the low and the high bound of every tensor's range.

        Both are finite and do not exceed the observed extremes, see :func:`within`.
        """


def check_option(name: str, option: str, value: float, largest: float) -> None:
    """Raise a RecipeError if an option is not above 0 and at most ``largest``."""
    if not 0 < value <= largest:  # NaN too
        raise RecipeError(
            f"{name}: {option} must be above 0 and at most {largest:g}, found {value:g}"
        )


def within(seen: Statistics, reach: Bounds) -> tuple[Bounds, Bounds]:
    """Clip the extremes of every tensor at plus and minus its reach.

    If all observed values are beyond the reach, the range shrinks to the nearest one.
    """
    lows, highs = seen.lows.min(axis=0), seen.highs.max(axis=0)
    low, high = np.maximum(lows, -reach), np.minimum(highs, reach)
    return np.minimum(low, highs), np.maximum(high, lows)


@dataclasses.dataclass(frozen=True)
class MaxMin(Observer):
    """Static max-min: the extremes over all frames, as in equation 3 of the paper.

    It differs from the moving average that other tools also call min-max.
    """

    name: ClassVar[str] = "max-min"

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the extremes over all frames."""
        return seen.lows.min(axis=0), seen.highs.max(axis=0)
