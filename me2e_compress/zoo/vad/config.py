"""Dimensions of VAD-tiny (hustvl/VAD, configs/VAD/VAD_tiny_e2e.py)."""

from dataclasses import dataclass
from typing import Literal

HeadsName = Literal["nuscenes", "bench2drive"]
Sampling = Literal["operator", "gather", "fused"]

CAMERAS = 6
IMAGE_HW = (384, 640)
"""Pixels: 0.4 of 900 x 1600, padded to a multiple of 32."""

EMBED = 256
ATTENTION_HEADS = 8
FEED_FORWARD = 512
LAYERS = 3
"""Of the BEV encoder, of the detection decoder and of the map decoder."""

BEV_HW = (100, 100)
PC_RANGE = (-15.0, -30.0, -2.0, 15.0, 30.0, 2.0)
"""x, y, z minima then maxima in metres; lidar frame, x right, y forward, z up."""

PILLAR_POINTS = 4
"""Heights at which a BEV cell is projected into the cameras."""

FEATURE_LEVELS = 4
"""Rows of the level embedding; only the first is used by the tiny model."""

AGENTS = 300
BOX_CODE = 10
"""cx, cy, log w, log l, cz, log h, sin, cos, vx, vy."""

VECTORS = 100
VECTOR_POINTS = 20

AGENT_MODES = 6
STEPS = 6
"""Of 0.5 s, for the agents and for the ego vehicle."""

MAP_SCORE = 0.5
"""A map vector is kept for motion above this probability."""

MAP_REACH = 0.2
"""An agent sees map vectors within this distance, in normalised BEV coordinates."""

ROTATION_CENTRE = (100.0, 100.0)
"""Of the previous BEV, in cells: the centre of the 200 x 200 base model, which all
public tiny models keep although it is the corner of their 100 x 100 grid."""


@dataclass(frozen=True)
class Heads:
    """What differs between the data sets: the sizes of the last layers."""

    det_classes: int
    map_classes: int
    ego_modes: int


HEADS: dict[HeadsName, Heads] = {
    "nuscenes": Heads(det_classes=10, map_classes=3, ego_modes=3),
    "bench2drive": Heads(det_classes=9, map_classes=6, ego_modes=6),
}
"""Bench2DriveZoo: 9 object and 6 map classes, 6 road options."""
