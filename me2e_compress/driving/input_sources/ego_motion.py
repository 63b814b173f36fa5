"""Input sources of the ego: its motion and its past, in the model's axes; its pose."""

import math
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np

from me2e_compress.driving.input_sources import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True)
class Speed(InputSource):
    """The speed, m/s: []."""

    name: ClassVar[str] = "speed"

    def value(self, seen: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(float(seen.observation.speed_mps))


@dataclass(frozen=True)
class Velocity(InputSource):
    """The speed as a vector along the vehicle, m/s: [2]."""

    name: ClassVar[str] = "velocity"

    def value(self, seen: Observed) -> Array:
        """Return float64 [2]."""
        return seen.turned([seen.observation.speed_mps, 0.0])


@dataclass(frozen=True)
class Acceleration(InputSource):
    """The acceleration, m/s2: [2], or [3].

    Attributes:
        vertical: Add the vertical component.
    """

    name: ClassVar[str] = "acceleration"
    vertical: bool = False

    def value(self, seen: Observed) -> Array:
        """Return float64 [2 or 3]."""
        forward, left, up = seen.observation.can_bus[10:13]
        level = seen.turned([forward, left])
        return np.append(level, up) if self.vertical else level


@dataclass(frozen=True)
class YawRate(InputSource):
    """The rate of turning, rad/s, counter-clockwise in right-handed axes: []."""

    name: ClassVar[str] = "yaw-rate"

    def value(self, seen: Observed) -> Array:
        """Return float64 []."""
        return np.asarray(seen.angle(float(seen.observation.can_bus[15])))


Quantity = Literal["x", "y", "heading", "speed"]


@dataclass(frozen=True)
class Past(InputSource):
    """States of the ego before now: [steps, quantities], the oldest first.

    Positions and headings are relative to the present pose, metres and radians in the
    model's axes; the present is not among them. Between decisions they are
    interpolated; before a route's first decision the ego stood still.

    Attributes:
        steps: How many states.
        spacing_s: Seconds from one to the next, the last being that long ago.
        quantities: Columns of the result: x, y, heading, speed (m/s).
        deltas: Changes from each state to the one after it, the last one to now.
        newest_first: Reverse the order.
    """

    name: ClassVar[str] = "past"
    steps: int
    spacing_s: float = 0.5
    quantities: tuple[Quantity, ...] = ("x", "y")
    deltas: bool = False
    newest_first: bool = False

    def __post_init__(self) -> None:
        if self.steps < 1 or not 0.0 < self.spacing_s < float("inf"):
            raise EvaluationError(
                f"past: {self.steps} steps {self.spacing_s:g} s apart: both must be"
                " positive"
            )

    def value(self, seen: Observed) -> Array:
        """Return float64 [steps, quantities]."""
        # the ego's states, the present one last
        now = seen.motion
        back = 1e6 * self.spacing_s * np.arange(self.steps, -1, -1)
        states = seen.track.at(seen.observation.time_us - back)
        # relative to the present pose, in the model's axes
        states[:, :3] -= (now.x, now.y, states[-1, 2])
        cos, sin = np.cos(now.heading), np.sin(now.heading)
        in_ego = states[:, :2] @ np.array([[cos, -sin], [sin, cos]])
        states[:, :2] = seen.turned(in_ego)
        states[:, 2] *= -1.0 if seen.axes.is_left_handed else 1.0
        found = np.diff(states, axis=0) if self.deltas else states[:-1]
        columns = [("x", "y", "heading", "speed").index(q) for q in self.quantities]
        return found[:: -1 if self.newest_first else 1, columns]


@dataclass(frozen=True)
class LidarToGlobalRotation(InputSource):
    """UniAD's ``l2g_r_mat``: [3, 3].

    From the model's ground frame, whose origin is under the centre of the ego, to the
    world, x east, y north.

    Attributes:
        transposed: For row vectors, p @ R + t, as UniAD of nuScenes takes it; else for
            column vectors, R @ p + t.
    """

    name: ClassVar[str] = "l2g-rotation"
    transposed: bool = True

    def value(self, seen: Observed) -> Array:
        """Return float64 [3, 3]."""
        cos, sin = math.cos(seen.motion.heading), math.sin(seen.motion.heading)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        rotation = turn @ seen.axes.to_ego
        return rotation.T if self.transposed else rotation


@dataclass(frozen=True)
class LidarToGlobalTranslation(InputSource):
    """UniAD's ``l2g_t``, metres: [3]."""

    name: ClassVar[str] = "l2g-translation"

    def value(self, seen: Observed) -> Array:
        """Return float64 [3]."""
        return np.array([seen.motion.x, seen.motion.y, 0.0])


@dataclass(frozen=True)
class CanBus(InputSource):
    """UniAD's and VAD's 18 numbers: [18].

    ``bench2drive``, as in the contract, has the speed at 7, acceleration at 10 and
    angular rates at 13. ``nuscenes`` (BEVFormer's ``_get_can_bus_info``) has
    acceleration at 7, angular rates at 10 and the velocity at 13. Both have the
    position at 0, the quaternion at 3, the heading in radians at 16, in degrees at 17.

    Attributes:
        layout: Which layout.
        absolute: Absolute position and degrees, for a model that compares them with
            those of its last frame itself; else the change since the last decision.
    """

    name: ClassVar[str] = "can-bus"
    layout: Literal["bench2drive", "nuscenes"] = "bench2drive"
    absolute: bool = False

    def value(self, seen: Observed) -> Array:
        """Return float32 [18]."""
        given = seen.observation.can_bus
        bus = np.array(given, np.float32)
        if self.layout == "nuscenes":
            bus[7:10], bus[10:13] = given[10:13], given[13:16]
            bus[13:16] = given[7], 0.0, 0.0
        if self.absolute:
            bus[0:2] = seen.motion.x, seen.motion.y
            bus[17] = math.degrees(bus[16])
        return bus
