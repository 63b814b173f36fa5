"""Input sources of the route ahead, of time, and of constants."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from me2e_compress.driving.input_sources import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

Six = tuple[int, int, int, int, int, int]


@dataclass(frozen=True)
class NavigationCommand(InputSource):
    """The command, a number [] or one-hot [classes].

    Attributes:
        numbers: The model's number of left, right, straight, follow the lane, change to
            the left and change to the right. The default is Bench2Drive's (CARLA's
            RoadOption less one); nuScenes' VAD, which has right, left and straight
            alone, is [1, 0, 2, 2, 1, 0].
        one_hot: How many classes the vector has; 0 gives the number itself.
    """

    name: ClassVar[str] = "command"
    numbers: Six = (0, 1, 2, 3, 4, 5)
    one_hot: int = 0

    def __post_init__(self) -> None:
        if self.one_hot and not 0 <= min(self.numbers) <= max(self.numbers) < (
            self.one_hot
        ):
            raise EvaluationError(
                f"command: numbers {list(self.numbers)} do not fit one_hot = "
                f"{self.one_hot} classes"
            )

    def value(self, seen: Observed) -> Array:
        """Return int64 [], or float32 [classes]."""
        number = self.number(seen.observation.command)
        if not self.one_hot:
            return np.asarray(number, np.int64)
        return np.asarray(np.eye(self.one_hot)[number], np.float32)

    def number(self, command: int) -> int:
        """Return the model's number of a command 0 to 5."""
        return self.numbers[command]


@dataclass(frozen=True)
class TargetPoint(InputSource):
    """A node of the route's sparse plan, metres in the model's axes: [2].

    Attributes:
        which: The next node, ``near``, or the one after it, ``far``.
    """

    name: ClassVar[str] = "target-point"
    which: Literal["near", "far"] = "near"

    def value(self, seen: Observed) -> Array:
        """Return float64 [2]."""
        points = seen.observation.target_points
        if points is None:
            raise EvaluationError(
                "the adapter asks for a target point, and the observation has none"
            )
        return seen.turned(points[0 if self.which == "near" else 1])


MICROSECONDS = 1_000_000
"""Microseconds in a second."""


@dataclass(frozen=True)
class Timestamp(InputSource):
    """Time since the route began: [].

    Attributes:
        unit: Seconds, or whole microseconds (nuScenes').
    """

    name: ClassVar[str] = "timestamp"
    unit: Literal["s", "us"] = "s"

    def value(self, seen: Observed) -> Array:
        """Return float64 [], or int64 []."""
        time_us = seen.observation.time_us
        if self.unit == "us":
            return np.asarray(time_us, np.int64)
        return np.asarray(time_us / MICROSECONDS)


@dataclass(frozen=True)
class UsePrevious(InputSource):
    """0 at the first decision of a route, then 1 (UniAD's ``use_prev_bev``): []."""

    name: ClassVar[str] = "use-previous"

    def value(self, seen: Observed) -> Array:
        """Return int64 []."""
        return np.asarray(int(seen.track.decisions > 1), np.int64)


LARGEST = 1e18
"""The largest value: within int64."""


@dataclass(frozen=True)
class ConstantInput(InputSource):
    """The same numbers at every decision.

    Attributes:
        values: The numbers, row by row.
        shape: Their shape; empty for one row of them.
    """

    name: ClassVar[str] = "constant"
    values: tuple[float, ...]
    shape: tuple[int, ...] = ()

    def __post_init__(self) -> None:
        if not all(abs(each) <= LARGEST for each in self.values):
            raise EvaluationError(f"constant: values must be finite, up to {LARGEST:g}")
        sides = self.shape or (len(self.values),)
        if min(sides) < 0 or math.prod(sides) != len(self.values):
            raise EvaluationError(
                f"constant: {len(self.values)} values have no shape {list(self.shape)}"
            )

    def value(self, seen: Observed) -> Array:
        """Return float64, or int64 where all values are whole numbers."""
        whole = all(each.is_integer() for each in self.values)
        array = np.array(self.values, np.int64 if whole else np.float64)
        return array.reshape(self.shape) if self.shape else array
