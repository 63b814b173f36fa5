"""Dimensions of VAD-tiny (hustvl/VAD, configs/VAD/VAD_tiny_e2e.py)."""

from dataclasses import dataclass
from typing import Literal

from models.bev.sizes import BevGrid

HeadsName = Literal["nuscenes", "bench2drive"]

RANGE = (-15.0, -30.0, -2.0, 15.0, 30.0, 2.0)

GRID = BevGrid((100, 100), RANGE, (100.0, 100.0))
"""The previous BEV rotates about the centre of the 200 x 200 base model, which all
public tiny models keep although it is the corner of their 100 x 100 grid."""

LAYERS = 3
"""Layers of the BEV encoder, the detection decoder and the map decoder each."""

AGENT_MODES = 6
STEPS = 6
"""Steps of 0.5 s, for the agents and for the ego vehicle."""

MAP_SCORE = 0.5
"""A map vector is kept for motion above this probability."""

MAP_REACH = 0.2
"""An agent sees map vectors within this distance, in normalised BEV coordinates."""


@dataclass(frozen=True)
class VadConfig:
    """Sizes of VAD; the defaults are the published ones.

    Attributes:
        image_hw: pixels: 0.4 of 900 x 1600, padded to a multiple of 32.
        stem: channels of the first stage of the backbone.
        grid: cells of the bird's eye view.
        agents: queries of the detection decoder.
        vectors: number of map vectors.
        vector_points: points per map vector.
    """

    image_hw: tuple[int, int] = (384, 640)
    stem: int = 64
    grid: BevGrid = GRID
    agents: int = 300
    vectors: int = 100
    vector_points: int = 20

    @property
    def feature_hws(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of the only feature level."""
        height, width = self.image_hw
        return ((height // 32, width // 32),)


PUBLISHED = VadConfig()


@dataclass(frozen=True)
class Heads:
    """The sizes of the last layers, which differ between data sets."""

    det_classes: int
    map_classes: int
    ego_modes: int


HEADS: dict[HeadsName, Heads] = {
    "nuscenes": Heads(det_classes=10, map_classes=3, ego_modes=3),
    "bench2drive": Heads(det_classes=9, map_classes=6, ego_modes=6),
}
"""Bench2DriveZoo: 9 object and 6 map classes, 6 road options."""
