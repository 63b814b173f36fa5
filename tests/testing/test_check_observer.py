from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from me2e_compress.calibration.observers import OBSERVERS, Bounds, Observer
from me2e_compress.calibration.observers.base import within
from me2e_compress.calibration.statistics import Statistics
from me2e_compress.errors import VerificationError
from me2e_compress.testing import check_observer


@pytest.mark.parametrize("name", OBSERVERS.names())
def test_our_observers_hold(name: str) -> None:
    lows, highs = check_observer(OBSERVERS.build(name, {}))
    assert lows.shape == highs.shape == (5,)


@dataclass(frozen=True)
class RootMeanSquare(Observer):
    """Some root mean squares to each side.

    Attributes:
        times: how many.
    """

    name: ClassVar[str] = "rms"
    times: float = 3.0

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        return within(seen, self.times * np.sqrt(seen.mean_squares.mean(axis=0)))


def test_an_observer_that_is_not_installed_holds_too() -> None:
    _, highs = check_observer(RootMeanSquare(4.0))
    assert highs[1] > 1


@dataclass(frozen=True)
class Plain(Observer):
    """Three root mean squares to each side; those below err in one way."""

    name: ClassVar[str] = "plain"

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        return RootMeanSquare(3.0).ranges(seen)


@dataclass(frozen=True)
class Drifting(Plain):
    """Another range each time."""

    calls: ClassVar[list[int]] = []

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        self.calls.append(1)
        lows, highs = super().ranges(seen)
        return lows, highs * np.float32(1 - 1e-3 * len(self.calls))


@dataclass(frozen=True)
class Beyond(Plain):
    """Not cut off."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        lows, highs = super().ranges(seen)
        return lows, highs + 1


@dataclass(frozen=True)
class Shared(Plain):
    """Tensors judged by the first."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        return within(seen, np.sqrt(seen.mean_squares[:, :1].mean(axis=0)))


@dataclass(frozen=True)
class Twisted(Plain):
    """Low is high."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        lows, highs = super().ranges(seen)
        return highs, lows


@dataclass(frozen=True)
class Doubles(Plain):
    """In float64."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        lows, highs = super().ranges(seen)
        wide: Any = highs.astype(np.float64)
        return lows, wide


@dataclass(frozen=True)
class Short(Plain):
    """A tensor too few."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        lows, highs = super().ranges(seen)
        return lows[1:], highs[1:]


@dataclass(frozen=True)
class Endless(Plain):
    """Infinite for a tensor of zeros."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        lows, highs = super().ranges(seen)
        return lows, np.where(highs == 0, np.float32(np.nan), highs)


@dataclass(frozen=True)
class Secretive(Plain):
    """Counts without saying so."""

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        seen.counted()
        return super().ranges(seen)


@dataclass(frozen=True)
class Wasteful(Plain):
    """Says that it counts."""

    counts: ClassVar[bool] = True


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Drifting(), "gives two ranges for one tensor"),
        (Beyond(), "reaches beyond what was seen"),
        (Shared(), "depends on the other tensors"),
        (Twisted(), "the low bound .* is above the high one"),
        (Doubles(), r"a bound is float64 \[5\], it must be float32 \[5\]"),
        (Short(), r"a bound is float32 \[4\], it must be float32 \[5\]"),
        (Endless(), "a bound is not finite"),
        (Secretive(), "reads histograms, and counts is False"),
        (Wasteful(), "reads no histograms, and counts is True"),
    ],
)
def test_a_wrong_observer_is_caught(bad: Observer, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_observer(bad)
