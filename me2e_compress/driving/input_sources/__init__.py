"""Input sources by name: what a model can be fed with.

To add a source: write its class, then add it to the table.
"""

import abc
import math
from bisect import bisect_right
from collections.abc import Mapping
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.registry import Registry
from me2e_compress.driving.contract import CAN_BUS_SIZE, EgoKinematics, Observation
from me2e_compress.runtime.frames import Array

__all__ = ["INPUT_SOURCES", "InputSource", "Observed"]
Floats = npt.NDArray[np.float64]


class Axes(StrEnum):
    """Ground frame of a model's waypoints and of its lidar2img."""

    FORWARD_LEFT = "forward-left"  # x forward, y left: ours
    RIGHT_FORWARD = "right-forward"  # x right, y forward: nuScenes' lidar, UniAD, VAD
    FORWARD_RIGHT = "forward-right"  # left-handed: CARLA's, Bench2DriveZoo's TCP
    RIGHT_BACKWARD = "right-backward"  # left-handed: OpenDriveLab's TCP

    @property
    def to_ego(self) -> npt.NDArray[np.float64]:
        """Matrix [3, 3] from this frame to the ego frame, orthogonal."""
        return np.array(_TO_EGO[self], np.float64)

    def projection(self, lidar2img: npt.ArrayLike) -> npt.NDArray[np.float32]:
        """Convert [n, 4, 4] projections of the ego frame to this frame."""
        turn = np.eye(4)
        turn[:3, :3] = self.to_ego
        return np.asarray(np.asarray(lidar2img, np.float64) @ turn, np.float32)

    @property
    def is_left_handed(self) -> bool:
        """Whether angles grow clockwise."""
        return self in (Axes.FORWARD_RIGHT, Axes.RIGHT_BACKWARD)


_TO_EGO = {
    Axes.FORWARD_LEFT: ((1, 0, 0), (0, 1, 0), (0, 0, 1)),
    Axes.RIGHT_FORWARD: ((0, 1, 0), (-1, 0, 0), (0, 0, 1)),
    Axes.FORWARD_RIGHT: ((1, 0, 0), (0, -1, 0), (0, 0, 1)),
    Axes.RIGHT_BACKWARD: ((0, -1, 0), (-1, 0, 0), (0, 0, 1)),
}


# The ego's motion since the last decision, and its poses on this route.


def can_bus_between(
    now: EgoKinematics, last: EgoKinematics | None
) -> npt.NDArray[np.float32]:
    """Return float32 [18] as in `Observation`; at a first decision ``last`` is None."""
    bus = np.zeros(CAN_BUS_SIZE, np.float64)
    # quaternion of the heading, then motion
    bus[3], bus[6] = math.cos(now.heading / 2), math.sin(now.heading / 2)
    bus[7] = now.speed_mps
    bus[10:13] = now.acceleration_mps2
    bus[13:16] = now.angular_velocity_radps
    bus[16] = now.heading % (2 * math.pi)
    # what changed since the last decision
    if last is not None:
        bus[0:2] = now.x - last.x, now.y - last.y
        turned = math.remainder(now.heading - last.heading, 2 * math.pi)
        bus[17] = math.degrees(turned)
    return bus.astype(np.float32)


class EgoTrack:
    """Poses and speeds by time, since the route began."""

    def __init__(self) -> None:
        self.decisions = 0
        self._times_us = list[int]()
        self._states = list[tuple[float, float, float, float]]()

    def note(self, time_us: int, motion: EgoKinematics | None) -> None:
        """Count a decision, and keep the ego's pose if it is known."""
        self.decisions += 1
        if motion is not None:
            state = (motion.x, motion.y, motion.heading, motion.speed_mps)
            self._times_us.append(time_us)
            self._states.append(state)

    def clear(self) -> None:
        """Begin a route."""
        self.decisions = 0
        self._times_us.clear()
        self._states.clear()

    def at(self, times_us: npt.NDArray[np.floating]) -> Floats:
        """Return [n, 4] of n times: x, y (m), heading (rad, unwrapped), speed (m/s)."""
        # Interpolate between decisions, constant before the first. Ignore what is older
        # than all of them: a route has thousands of states.
        first = max(0, bisect_right(self._times_us, float(np.min(times_us))) - 1)
        states = np.array(self._states[first:], np.float64)
        states[:, 2] = np.unwrap(states[:, 2])
        known = self._times_us[first:]
        return np.stack([np.interp(times_us, known, c) for c in states.T], axis=1)


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """The data of a decision that sources may use."""

    observation: Observation
    axes: Axes
    track: EgoTrack  # this decision included
    # float32 (cameras, 4, 4), ego frame to pixels of each image input as the model sees
    # it, by its name; without image inputs, by the empty name, of the six cameras
    projections: Mapping[str, npt.NDArray[np.float32]]

    @property
    def motion(self) -> EgoKinematics:
        """The ego's pose and motion."""
        if self.observation.motion is None:
            raise EvaluationError(
                "the adapter asks where the ego is, and the observation does not say"
            )
        return self.observation.motion

    def turned(self, vectors: npt.ArrayLike) -> npt.NDArray[np.float64]:
        """Turn [..., 2] of the ego frame into the model's."""
        return np.asarray(vectors, np.float64) @ self.axes.to_ego[:2, :2]

    def angle(self, counter_clockwise: float) -> float:
        """Convert an angle, or a rate of one, to the model's axes."""
        return -counter_clockwise if self.axes.is_left_handed else counter_clockwise


@dataclass(frozen=True)
class InputSource(abc.ABC):
    """Turns one fact about a decision into numbers; its fields are its options."""

    name: ClassVar[str]

    @abc.abstractmethod
    def value(self, observed: Observed) -> Array:
        """Return an array of fixed shape and type, without a batch dimension.

        Raises:
            EvaluationError: The observation lacks the data.
        """


_HERE = "me2e_compress.driving.input_sources.sources"

INPUT_SOURCES: Registry[InputSource] = Registry(
    "input source",
    "me2e_compress.input_sources",
    EvaluationError,
    {
        "speed": f"{_HERE}:Speed",
        "velocity": f"{_HERE}:Velocity",
        "acceleration": f"{_HERE}:Acceleration",
        "yaw-rate": f"{_HERE}:YawRate",
        "command": f"{_HERE}:NavigationCommand",
        "target-point": f"{_HERE}:TargetPoint",
        "past": f"{_HERE}:Past",
        "can-bus": f"{_HERE}:CanBus",
        "timestamp": f"{_HERE}:Timestamp",
        "use-previous": f"{_HERE}:UsePrevious",
        "l2g-rotation": f"{_HERE}:LidarToGlobalRotation",
        "l2g-translation": f"{_HERE}:LidarToGlobalTranslation",
        "lidar2img": f"{_HERE}:LidarToImage",
        "lidar2cam": f"{_HERE}:LidarToCamera",
        "intrinsics": f"{_HERE}:Intrinsics",
        "constant": f"{_HERE}:ConstantInput",
    },
)
