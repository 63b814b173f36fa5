"""From frames to ranges to the int8 step: what every observer is, and max-min."""

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


Bounds: TypeAlias = npt.NDArray[np.float32]
"""The low or the high bound of the range of every tensor: float32 [tensors]."""


@dataclasses.dataclass(frozen=True)
class Observer(abc.ABC):
    """From statistics to ranges: derive a frozen dataclass, its fields are options.

    Class attributes:
        name: what recipes and the command line call it.
        counts: True if it needs histograms, a second pass over the frames.
    """

    name: ClassVar[str]
    counts: ClassVar[bool] = False

    @abc.abstractmethod
    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the low and the high bound of every tensor's range.

        Both are finite, and within what was seen of the tensor: see :func:`within`.
        """


def check_option(name: str, option: str, value: float, largest: float) -> None:
    """Refuse the option of an observer that is not above 0 and at most ``largest``.

    Raises:
        RecipeError: names observer and option.
    """
    if not 0 < value <= largest:  # NaN too
        raise RecipeError(
            f"{name}: {option} must be above 0 and at most {largest:g}, found {value:g}"
        )


def within(seen: Statistics, reach: Bounds) -> tuple[Bounds, Bounds]:
    """Clip the extremes of every tensor at plus and minus its reach.

    Where all that was seen lies beyond the reach, the range shrinks to the nearest
    value that was seen.
    """
    lows, highs = seen.lows.min(axis=0), seen.highs.max(axis=0)
    low, high = np.maximum(lows, -reach), np.minimum(highs, reach)
    return np.minimum(low, highs), np.maximum(high, lows)


@dataclasses.dataclass(frozen=True)
class MaxMin(Observer):
    """Static max-min: the extremes over all frames, as equation 3 of the paper reads.

    Not the moving average that other tools call min-max too.
    """

    name: ClassVar[str] = "max-min"

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the extremes over all frames."""
        return seen.lows.min(axis=0), seen.highs.max(axis=0)


@dataclasses.dataclass(frozen=True)
class MovingAverage(Observer):
    """Exponential moving average of the extremes, in the order of the frames.

    ``range += weight * (frame - range)``, begun at the first frame. A rare extreme
    counts for little, and is clipped.

    Attributes:
        weight: of a new frame, above 0 and at most 1; the default is that of torch's
            ``MovingAverageMinMaxObserver``.

    Raises:
        RecipeError: another weight.
    """

    name: ClassVar[str] = "moving-average"
    weight: float = 0.01

    def __post_init__(self) -> None:
        """Check the weight."""
        check_option(self.name, "weight", self.weight, 1.0)

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        """Return the averages after the last frame."""
        return self._average(seen.lows), self._average(seen.highs)

    def _average(self, bounds: Bounds) -> Bounds:
        mean = bounds[0].astype(np.float64)
        for each in bounds[1:]:
            mean += self.weight * (each - mean)
        return np.asarray(mean, np.float32)
