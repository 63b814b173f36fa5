"""What both data sets give: moments, which become frames of a model.

Coordinate frames: *lidar* is x right, y forward, z up at the roof lidar (nuScenes,
UniAD, VAD); *ego* is x forward, y left, z up on the ground under the centre of the
vehicle; the *world* is right-handed. A matrix ``a_to_b`` [4, 4] maps (x, y, z, 1) of a
to b.
"""

from abc import abstractmethod
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Self, TypeAlias

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.recording import DriveLog

Floats: TypeAlias = npt.NDArray[np.float64]

CAMERAS = (
    "CAM_FRONT",
    "CAM_FRONT_LEFT",
    "CAM_FRONT_RIGHT",
    "CAM_BACK",
    "CAM_BACK_LEFT",
    "CAM_BACK_RIGHT",
)
"""Cameras in the order of Bench2Drive's models."""

CAN_BUS_SIZE = 18


@dataclass(frozen=True, eq=False)
class LogMoment:
    """The recorded data of one moment.

    Attributes:
        time_us: microseconds since any fixed time.
        pictures: the file of each camera.
        lidar_to_image: [4, 4] of each camera: lidar metres to (u * depth, v * depth,
            depth, 1), pixels of the whole picture.
        lidar_to_world: [4, 4].
        lidar_to_ego: [4, 4].
        l2g_rows: whether the data set's own models take the rotation of lidar to
            world for rows (p @ r), which is its transpose.
        can_bus: [18] as the data set's own models take it, but [0:3] is the position
            and [17] the heading in degrees, not their changes.
        command: the route's next command, numbered as in the data set's models; None
            where the log has none.
    """

    time_us: int
    pictures: Mapping[str, Path]
    lidar_to_image: Mapping[str, Floats]
    lidar_to_world: Floats
    lidar_to_ego: Floats
    l2g_rows: bool
    can_bus: Floats
    command: int | None


LogScene: TypeAlias = Sequence[LogMoment]
"""Moments in order, read lazily."""


@dataclass(frozen=True, kw_only=True)
class CameraLog(DriveLog):
    """A data set of driving that cameras recorded; `frames` lays out its moments.

    Attributes:
        scenes: names of the scenes; empty means all.
        cameras: cameras in the order of the image input; empty means all six, in the
            order of the models that are trained on it.
        every: takes every n-th moment.
        size: rows and columns of the image input, where the model leaves them open.
        width: columns of the image input that a picture takes, the others are zeros;
            None takes the stack's value, else all.
    """

    half_second: ClassVar[int]
    """Number of moments in half a second."""

    scenes: tuple[str, ...] = ()
    cameras: tuple[str, ...] = ()
    every: int = 1
    size: tuple[int, int] | None = None
    width: int | None = None

    def __post_init__(self) -> None:
        if self.every < 1:
            raise ValueError(f"every {self.every}: must be at least 1")
        if self.width is not None and self.width < 1:
            raise ValueError(f"width {self.width}: must be at least 1")
        if self.size is not None and min(self.size) < 1:
            raise ValueError(f"size {list(self.size)}: must be at least 1")

    @abstractmethod
    def names(self) -> Sequence[str]:
        """List the scenes in order.

        Raises:
            FramesError: it is no such data set; the message names what is missing.
        """

    @abstractmethod
    def scene(self, name: str) -> LogScene:
        """Return the moments of a scene.

        Raises:
            FramesError: something of it is missing or malformed.
        """

    @abstractmethod
    def command_of(self, right_m: float) -> int:
        """Return the command of a route that ends so far to the right in 3 s.

        It is called where `LogMoment.command` is None.
        """

    def chosen(self) -> tuple[str, ...]:
        """List the requested scenes; FramesError if one is missing."""
        there = tuple(self.names())
        for name in self.scenes:
            if name not in there:
                some = ", ".join(there[:5]) + (", ..." if len(there) > 5 else "")
                raise FramesError(f"{self.name}: no scene {name!r}; there are {some}")
        return self.scenes or there

    def as_contract(self) -> Self:
        """Return the log with CAN bus and commands as in the policy contract."""
        return self

    @property
    def all_cameras(self) -> tuple[str, ...]:
        """All cameras, in the order of the models that are trained on it."""
        return CAMERAS

    @property
    def seen(self) -> tuple[str, ...]:
        """The chosen cameras, in their order."""
        return self.cameras or self.all_cameras


def pose(rotation: Sequence[float], translation: Sequence[float], what: str) -> Floats:
    """Return the [4, 4] of a quaternion w, x, y, z and a translation."""
    w, x, y, z = found = np.array(rotation, np.float64)
    size = float(found @ found)
    if not (np.isfinite(size) and np.isfinite(translation).all() and size > 0):
        raise FramesError(f"{what}: the pose is not finite")
    s = 2.0 / size
    out = np.eye(4)
    out[:3, :3] = [
        [1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w)],
        [s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w)],
        [s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y)],
    ]
    out[:3, 3] = translation
    return out


def intrinsics(matrix: object, what: str) -> Floats:
    """Return the [4, 4] of a [3, 3] camera matrix."""
    out = np.eye(4)
    out[:3, :3] = matrix_of(matrix, (3, 3), what)
    return out


def matrix_of(value: object, shape: tuple[int, ...], what: str) -> Floats:
    """Convert a file's value to an array of this shape, with finite numbers."""
    try:
        found = np.array(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise FramesError(f"{what}: no {list(shape)} of numbers") from error
    if found.shape != shape:
        raise FramesError(f"{what}: has shape {list(found.shape)}, not {list(shape)}")
    if not np.isfinite(found).all():
        raise FramesError(f"{what}: is not finite")
    return found


def heading_of(a_to_b: Floats) -> float:
    """Return the direction of lidar's y axis in b, radians from the x axis of b."""
    return float(np.arctan2(a_to_b[1, 1], a_to_b[0, 1]))
