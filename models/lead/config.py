"""Dimensions of TransFuser v6 (autonomousvision/lead 8bb1118, config_training.py)."""

from dataclasses import dataclass

COMMANDS = 6
"""Road options of CARLA, as a one-hot vector."""

MAX_SPEED_MPS = 25.0
"""What the speed is divided by; on CARLA."""

TARGET_POINT_M = (200.0, 50.0)
"""What a target point is divided by: ahead, and to the right."""

TARGET_POINTS = ("target_point", "target_point_previous", "target_point_next")
"""In the order of their tokens."""

TARGET_SPEEDS_MPS = (0.0, 4.0, 8.0, 10.0, 13.88888888, 16.0, 17.77777777, 20.0)

SEMANTIC_CLASSES, BEV_CLASSES, BOX_CLASSES = 10, 13, 8
"""Of the camera strip, of the bird's eye view, and of boxes."""

YAW_BINS = 12

METRES_BEHIND = 1 / 3
"""Share of the raster that lies behind the vehicle: 32 m of 96."""

CELLS_PER_M = 4.0
"""Resolution of the raster."""

WAYPOINT_S = 0.25

STRIDE = 32
"""Of the last stage, and pixels a side that are one token of the fusion."""


@dataclass(frozen=True)
class LeadConfig:
    """Sizes of TransFuser v6; the defaults are the published ones, on ResNet-34.

    Attributes:
        image_hw: pixels of the strip of three cameras.
        raster_hw: cells of the LiDAR's raster: to the right, and ahead.
        stem: channels of the first stage of both trunks.
        fusion_layers: blocks of a fusion transformer.
        fusion_heads: heads of its attention.
        token: width of the planner.
        planner_layers: layers of its decoder.
        planner_heads: heads of its attention.
        feed_forward: width inside a layer of its decoder.
        features: channels of the bird's eye view that is decoded.
        semantic: channels of the decoder of the strip, from coarse to fine.
        route: points of the route, about a metre apart.
        waypoints: number of waypoints, 0.25 s apart.
    """

    image_hw: tuple[int, int] = (384, 1152)
    raster_hw: tuple[int, int] = (320, 384)
    stem: int = 64
    fusion_layers: int = 2
    fusion_heads: int = 4
    token: int = 256
    planner_layers: int = 6
    planner_heads: int = 8
    feed_forward: int = 2048
    features: int = 64
    semantic: tuple[int, int, int] = (128, 64, 32)
    route: int = 10
    waypoints: int = 8

    @property
    def image_tokens(self) -> tuple[int, int]:
        """Rows and columns of the strip's tokens."""
        return self.image_hw[0] // STRIDE, self.image_hw[1] // STRIDE

    @property
    def raster_tokens(self) -> tuple[int, int]:
        """Rows and columns of the raster's tokens."""
        return self.raster_hw[0] // STRIDE, self.raster_hw[1] // STRIDE


CONFIGS = {
    "lead": LeadConfig(),
    "lead-tiny": LeadConfig(
        image_hw=(64, 192),
        raster_hw=(64, 96),
        stem=8,
        fusion_layers=1,
        token=32,
        planner_layers=2,
        planner_heads=4,
        feed_forward=64,
        features=16,
        semantic=(16, 8, 8),
    ),
}
"""By the name of the stack: the published size, and one for tests."""
