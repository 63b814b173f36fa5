"""The ground frame in which a model sees, and plans."""

from enum import StrEnum

import numpy as np
import numpy.typing as npt


class Axes(StrEnum):
    """Ground frame of a model's waypoints and of its lidar2img."""

    FORWARD_LEFT = "forward-left"
    """x forward, y left: ours."""
    RIGHT_FORWARD = "right-forward"
    """x right, y forward: the lidar of nuScenes, of UniAD and of VAD."""
    FORWARD_RIGHT = "forward-right"
    """x forward, y right, left-handed: CARLA's, and Bench2DriveZoo's TCP's."""
    RIGHT_BACKWARD = "right-backward"
    """x right, y backward, left-handed: OpenDriveLab's TCP's."""

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
