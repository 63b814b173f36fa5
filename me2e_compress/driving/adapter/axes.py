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

    @property
    def to_ego(self) -> npt.NDArray[np.float64]:
        """Rotation [3, 3] from this frame to the ego frame."""
        if self is Axes.FORWARD_LEFT:
            return np.eye(3)
        return np.array([[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
