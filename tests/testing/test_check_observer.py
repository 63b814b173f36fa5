import itertools
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
import pytest

from me2e_compress.calibration.observers import OBSERVERS, Bounds, Observer, within
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


def nothing_for_zeros(lows: Bounds, highs: Bounds) -> tuple[Bounds, Bounds]:
    return lows, np.where(highs == 0, np.float32(np.nan), highs)


def in_float64(lows: Bounds, highs: Bounds) -> tuple[Bounds, Bounds]:
    wide: Any = highs.astype(np.float64)
    return lows, wide


CALLS = itertools.count(1)
ALTERED: dict[str, Callable[[Bounds, Bounds], tuple[Bounds, Bounds]]] = {
    "drifts": lambda lows, highs: (lows, highs * np.float32(1 - 1e-3 * next(CALLS))),
    "beyond": lambda lows, highs: (lows, highs + 1),
    "twisted": lambda lows, highs: (highs, lows),
    "in float64": in_float64,
    "short": lambda lows, highs: (lows[1:], highs[1:]),
    "not finite": nothing_for_zeros,
}


@dataclass(frozen=True)
class Wrong(Observer):
    """Three root mean squares to each side, altered in one way.

    Attributes:
        way: in which it errs.
    """

    name: ClassVar[str] = "wrong"
    way: str

    def ranges(self, seen: Statistics) -> tuple[Bounds, Bounds]:
        if self.way == "of the first":
            return within(seen, np.sqrt(seen.mean_squares[:, :1].mean(axis=0)))
        if self.way == "counts":
            seen.counted()
        lows, highs = RootMeanSquare(3.0).ranges(seen)
        return ALTERED[self.way](lows, highs) if self.way in ALTERED else (lows, highs)


@dataclass(frozen=True)
class Wasteful(Wrong):
    """Says that it counts.

    Attributes:
        way: none.
    """

    counts: ClassVar[bool] = True


@pytest.mark.parametrize(
    ("bad", "message"),
    [
        (Wrong("drifts"), "gives two ranges for one tensor"),
        (Wrong("beyond"), "reaches beyond what was seen"),
        (Wrong("of the first"), "depends on the other tensors"),
        (Wrong("twisted"), "the low bound .* is above the high one"),
        (Wrong("in float64"), r"a bound is float64 \[5\], it must be float32 \[5\]"),
        (Wrong("short"), r"a bound is float32 \[4\], it must be float32 \[5\]"),
        (Wrong("not finite"), "a bound is not finite"),
        (Wrong("counts"), "reads histograms, and counts is False"),
        (Wasteful(""), "reads no histograms, and counts is True"),
    ],
)
def test_a_wrong_observer_is_caught(bad: Observer, message: str) -> None:
    with pytest.raises(VerificationError, match=message):
        check_observer(bad)
