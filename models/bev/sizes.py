"""Dimensions that VAD-tiny and UniAD-tiny share, and the grid in which they differ."""

from dataclasses import dataclass
from typing import Literal

Sampling = Literal["operator", "gather", "fused"]

CAMERAS = 6
EMBED = 256
ATTENTION_HEADS = 8
FEED_FORWARD = 512

PILLAR_POINTS = 4
"""Heights at which a BEV cell is projected into the cameras."""

FEATURE_LEVELS = 4
"""Rows of the level embedding, of which VAD-tiny uses the first."""

BOX_CODE = 10
"""cx, cy, log w, log l, cz, log h, sin, cos, vx, vy."""


@dataclass(frozen=True)
class BevGrid:
    """Cells around the vehicle.

    Attributes:
        hw: rows and columns.
        pc_range: x, y, z minima then maxima in metres; lidar frame, x right, y forward,
            z up.
        rotation_centre: of the previous BEV, in cells: column and row.
    """

    hw: tuple[int, int]
    pc_range: tuple[float, float, float, float, float, float]
    rotation_centre: tuple[float, float]

    @property
    def cells(self) -> int:
        """The number of cells."""
        return self.hw[0] * self.hw[1]
