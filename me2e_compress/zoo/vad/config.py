"""Dimensions of VAD-tiny (hustvl/VAD, configs/VAD/VAD_tiny_e2e.py)."""

from dataclasses import dataclass
from typing import Literal

from me2e_compress.zoo.bev.sizes import BevGrid

HeadsName = Literal["nuscenes", "bench2drive"]

IMAGE_HW = (384, 640)
"""Pixels: 0.4 of 900 x 1600, padded to a multiple of 32."""

GRID = BevGrid(
    hw=(100, 100),
    pc_range=(-15.0, -30.0, -2.0, 15.0, 30.0, 2.0),
    rotation_centre=(100.0, 100.0),
)
"""The previous BEV turns about the centre of the 200 x 200 base model, which all public
tiny models keep although it is the corner of their 100 x 100 grid."""

FEATURE_HWS = ((IMAGE_HW[0] // 32, IMAGE_HW[1] // 32),)
"""Rows and columns of the only feature level."""

LAYERS = 3
"""Of the BEV encoder, of the detection decoder and of the map decoder."""


AGENTS = 300

VECTORS = 100
VECTOR_POINTS = 20

AGENT_MODES = 6
STEPS = 6
"""Of 0.5 s, for the agents and for the ego vehicle."""

MAP_SCORE = 0.5
"""A map vector is kept for motion above this probability."""

MAP_REACH = 0.2
"""An agent sees map vectors within this distance, in normalised BEV coordinates."""


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
