"""Where the model's ground frame lies in the world, as UniAD's tracker is told.

The frame has its origin under the centre of the ego; the world is x east, y north.
"""

import math
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from me2e_compress.driving.input_sources.base import InputSource, Observed
from me2e_compress.runtime.frames import Array


@dataclass(frozen=True)
class LidarToGlobalRotation(InputSource):
    """UniAD's ``l2g_r_mat``: [3, 3].

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
