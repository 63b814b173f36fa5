"""Sizes of the driver."""

from dataclasses import dataclass


@dataclass(frozen=True)
class BevArea:
    """What the bird's-eye view covers; row 0 is farthest ahead, column 0 farthest left.

    Attributes:
        front_m: x of the upper edge, in the ego frame (x forward, y left).
        left_m: y of the left edge.
        cell_m: side of a cell.
        rows: cells from front to back.
        columns: cells from left to right.
    """

    front_m: float = 48.0
    left_m: float = 24.0
    cell_m: float = 2.0
    rows: int = 32
    columns: int = 24

    @property
    def cells(self) -> int:
        """How many cells there are."""
        return self.rows * self.columns


@dataclass(frozen=True)
class HighwayConfig:
    """Sizes of every module.

    Attributes:
        image_size: rows and columns of a camera image.
        stages: channels of the backbone at strides 2, 4, 8 and 16.
        channels: width of every token.
        heads: of attention.
        heights_m: heights at which a cell is looked up in the images: the road,
            the middle of a car, eye level, the lamps of a light.
        memory_s: time constant of the recurrent bird's-eye view.
        agents: agent queries, the strongest peaks of the detection map.
        modes: futures of an agent.
        path_points: points of a route, every `PATH_STEP_M`.
        anchors: candidate plans.
        area: the bird's-eye view.
    """

    image_size: tuple[int, int] = (96, 160)
    stages: tuple[int, int, int, int] = (16, 32, 64, 96)
    channels: int = 64
    heads: int = 4
    heights_m: tuple[float, ...] = (0.0, 0.8, 1.6, 2.4)
    memory_s: float = 0.4
    agents: int = 20
    modes: int = 3
    path_points: int = 25
    anchors: int = 64
    area: BevArea = BevArea()


PATH_STEP_M = 2.0
"""Spacing of the points of a predicted route."""
STEPS = 6
"""Waypoints of a plan and of a future, every `STEP_S`: the policy contract."""
STEP_S = 0.5
"""Between two waypoints."""
COMMANDS = 6
"""Left, right, straight, follow, change left, change right."""
CAMERAS = 6
"""Front, front left, front right, back, back left, back right: the order of the rig."""
AGENT_CLASSES = 4
"""Vehicle, bicycle, pedestrian, static."""
SIGNAL_KINDS = 3
"""Light, stop sign, give-way sign."""
SIGNAL_STATES = 3
"""Red, yellow, green."""
RASTER_CHANNELS = 4
"""Road, shoulder, lane marking, stop line."""
