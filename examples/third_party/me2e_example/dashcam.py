"""Rides seen by one camera behind the windscreen."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

import numpy as np

from me2e_compress.calibration.logs import DriveLog, LogMoment, LogScene
from me2e_compress.errors import FramesError

HEIGHT_M = 1.3
LIDAR_TO_EGO = np.array([[0, 1, 0, 0], [-1, 0, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1.0]])
"""There is no lidar: the frame x right, y forward lies where the ego's lies."""
LOOKS = np.array([[1, 0, 0, 0], [0, 0, -1, HEIGHT_M], [0, 1, 0, 0], [0, 0, 0, 1.0]])
"""Lidar to camera: x right, y down, z forward."""


@dataclass(frozen=True)
class Dashcam(DriveLog):
    """Folders RIDE/0000.jpg, ... every half second, with track.csv: x, y, heading.

    Attributes:
        root: the folder that holds the rides.
        focal_px: of the camera; its middle is that of a picture of 1280 x 720.
        scenes: rides by name; none means all.
        cameras: must be left as it is.
        every: takes every n-th picture.
        size: rows and columns of the image input, where the model leaves them open.
        width: columns of the image input that a picture takes; None means all.
    """

    name: ClassVar[str] = "dashcam"
    half_second: ClassVar[int] = 1
    ego_size: ClassVar[tuple[float, float]] = (4.5, 1.8)

    root: Path = field(kw_only=False)
    focal_px: float = 900.0
    cameras: tuple[str, ...] = field(default=("CAM_FRONT",), kw_only=True)

    def names(self) -> Sequence[str]:
        """List the rides."""
        return sorted(path.parent.name for path in self.root.glob("*/track.csv"))

    def scene(self, name: str) -> LogScene:
        """Return the moments of a ride."""
        path = self.root / name / "track.csv"
        try:
            track = np.loadtxt(path, delimiter=",", ndmin=2)
        except (OSError, ValueError) as error:
            raise FramesError(f"{path}: {error}") from error
        return [self._moment(path.parent, at, *row) for at, row in enumerate(track)]

    def command_of(self, right_m: float) -> int:
        """Return left, right or follow the lane, as the policy contract counts."""
        return 3 if abs(right_m) < 2.0 else 1 if right_m > 0 else 0

    def _moment(
        self, ride: Path, at: int, x: float, y: float, heading: float
    ) -> LogMoment:
        cos, sin = math.cos(heading), math.sin(heading)
        ego_to_world = np.array(
            [[cos, -sin, 0, x], [sin, cos, 0, y], [0, 0, 1, 0], [0, 0, 0, 1.0]]
        )
        lens = np.diag([self.focal_px, self.focal_px, 1.0, 1.0])
        lens[:2, 2] = 640.0, 360.0
        can_bus = np.zeros(18)
        can_bus[:3] = x, y, 0.0
        can_bus[16], can_bus[17] = heading, math.degrees(heading)
        return LogMoment(
            time_us=500_000 * at,
            pictures={"CAM_FRONT": ride / f"{at:04d}.jpg"},
            lidar_to_image={"CAM_FRONT": lens @ LOOKS},
            lidar_to_world=ego_to_world @ LIDAR_TO_EGO,
            lidar_to_ego=LIDAR_TO_EGO,
            l2g_rows=True,
            can_bus=can_bus,
            agents=None,
            command=None,
        )
