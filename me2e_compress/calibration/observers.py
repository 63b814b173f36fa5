"""From the extremes of every frame to one range a tensor."""

import dataclasses
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Extremes: TypeAlias = npt.NDArray[np.float32]
"""One number a tensor."""

QUANT_MAX = 127
"""Largest int8 magnitude in use: -128 is left out, so that the grid is symmetric."""


class Observer(Protocol):
    """Takes the extremes of all tensors, frame by frame."""

    @property
    def method(self) -> str:
        """What the method is called in recipes and saved ranges."""
        ...

    def update(self, lows: Extremes, highs: Extremes) -> None:
        """Take one frame: the smallest and largest element of every tensor."""
        ...

    def result(self) -> tuple[Extremes, Extremes]:
        """Give the low and the high end of every tensor's range."""
        ...


@dataclasses.dataclass
class MaxMin:
    """Static max-min: the extremes over all frames, as equation 3 of the paper reads.

    Not the moving average that other tools call min-max too.
    """

    lows: Extremes | None = None
    highs: Extremes | None = None
    method: str = "max-min"

    def update(self, lows: Extremes, highs: Extremes) -> None:
        """Widen every range to hold this frame."""
        self.lows = lows if self.lows is None else np.minimum(self.lows, lows)
        self.highs = highs if self.highs is None else np.maximum(self.highs, highs)

    def result(self) -> tuple[Extremes, Extremes]:
        """Give the extremes; empty if no frame was seen."""
        nothing = np.empty(0, np.float32)
        return (
            nothing if self.lows is None else self.lows,
            nothing if self.highs is None else self.highs,
        )


METHODS: dict[str, type[MaxMin]] = {"max-min": MaxMin}


def scale_of(low: float, high: float) -> np.float32:
    """Give the int8 step of a range: ``max(|low|, |high|) / 127``, zero point 0.

    Equation 3 of the paper divides ``high - low`` by ``q_max - q_min``. That fits a
    range centred on zero; with zero point 0 it would clip the upper half of a tensor
    that is never negative (what follows a ReLU). So the range is first made symmetric,
    [-r, r] with r = max(|low|, |high|), and the formula gives 2r / 254 = r / 127.

    A tensor that is zero throughout has no step of its own: it gets 1.
    """
    reach = max(abs(low), abs(high))
    step = np.float32(reach / QUANT_MAX)
    return step if step > 0 else np.float32(1)
