"""What every way from frames to ranges is."""

from typing import ClassVar, Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.calibration.statistics import Statistics

Ends: TypeAlias = npt.NDArray[np.float32]
"""One end of the range of every tensor: float32 [tensors]."""


class Observer(Protocol):
    """A frozen dataclass whose fields are its options.

    Class attributes:
        name: what recipes and the command line call it.
        counts: True if it needs histograms, a second pass over the frames.
    """

    name: ClassVar[str]
    counts: ClassVar[bool]

    @property
    def text(self) -> str:
        """The method with its number, as :func:`observer` reads it."""
        ...

    def ranges(self, seen: Statistics) -> tuple[Ends, Ends]:
        """Give the low and the high end of every tensor's range."""
        ...


def within(seen: Statistics, reach: Ends) -> tuple[Ends, Ends]:
    """Cut the extremes of every tensor off at plus and minus its reach."""
    lows, highs = seen.lows.min(axis=0), seen.highs.max(axis=0)
    return np.maximum(lows, -reach), np.minimum(highs, reach)
