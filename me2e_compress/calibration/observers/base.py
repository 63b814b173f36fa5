"""What every way from frames to ranges is."""

import abc
import dataclasses
from typing import ClassVar, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.statistics import Statistics
from me2e_compress.errors import RecipeError

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
    """Cut the extremes of every tensor off at plus and minus its reach."""
    lows, highs = seen.lows.min(axis=0), seen.highs.max(axis=0)
    return np.maximum(lows, -reach), np.minimum(highs, reach)
