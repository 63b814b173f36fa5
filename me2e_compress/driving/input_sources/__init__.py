"""Input sources by name: what a model can be fed with.

To add a source: write its class, then add it to the table.
"""

import abc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.axes import Axes
from me2e_compress.driving.contract import EgoKinematics, Observation
from me2e_compress.driving.ego_track import EgoTrack
from me2e_compress.errors import EvaluationError
from me2e_compress.registry import Registry
from me2e_compress.runtime.frames import Array

__all__ = ["INPUT_SOURCES", "InputSource", "Observed"]


@dataclass(frozen=True, eq=False, slots=True)
class Observed:
    """The data of a decision that sources may use.

    ``track`` includes this decision. ``projections`` map the ego frame to pixels of
    each image input as the model sees it, float32 [cameras, 4, 4], by the input's name;
    without image inputs, under the empty name, to those of the six cameras.
    """

    observation: Observation
    axes: Axes
    track: EgoTrack
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
    def value(self, seen: Observed) -> Array:
        """Return an array of fixed shape and type, without a batch dimension.

        Raises:
            EvaluationError: The observation lacks the data.
        """


_HERE = "me2e_compress.driving.input_sources"

INPUT_SOURCES: Registry[InputSource] = Registry(
    "input source",
    "me2e_compress.input_sources",
    EvaluationError,
    {
        "speed": f"{_HERE}.ego_motion:Speed",
        "velocity": f"{_HERE}.ego_motion:Velocity",
        "acceleration": f"{_HERE}.ego_motion:Acceleration",
        "yaw-rate": f"{_HERE}.ego_motion:YawRate",
        "command": f"{_HERE}.navigation:NavigationCommand",
        "target-point": f"{_HERE}.navigation:TargetPoint",
        "past": f"{_HERE}.ego_motion:Past",
        "can-bus": f"{_HERE}.ego_motion:CanBus",
        "timestamp": f"{_HERE}.navigation:Timestamp",
        "use-previous": f"{_HERE}.navigation:UsePrevious",
        "l2g-rotation": f"{_HERE}.ego_motion:LidarToGlobalRotation",
        "l2g-translation": f"{_HERE}.ego_motion:LidarToGlobalTranslation",
        "lidar2img": f"{_HERE}.camera_geometry:LidarToImage",
        "lidar2cam": f"{_HERE}.camera_geometry:LidarToCamera",
        "intrinsics": f"{_HERE}.camera_geometry:Intrinsics",
        "constant": f"{_HERE}.navigation:ConstantInput",
    },
)
