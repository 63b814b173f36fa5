"""Dimensions of UniAD-tiny (Bench2DriveZoo, tiny_e2e_b2d.py)."""

from dataclasses import dataclass

from me2e_compress.zoo.bev.sizes import BevGrid

COMMANDS = 6
AGENT_MODES = 6
AGENT_STEPS = 12
PLAN_STEPS = 6
"""Of 0.5 s each."""

THINGS = 6
"""Map classes that are instances; there are none that are not."""

MEMORY = 4
"""Past embeddings that are kept of a track."""


GRID = BevGrid(
    hw=(100, 100),
    pc_range=(-51.2, -51.2, -5.0, 51.2, 51.2, 3.0),
    rotation_centre=(100.0, 100.0),
)


@dataclass(frozen=True)
class UniadConfig:
    """Sizes; the defaults are Bench2DriveZoo's.

    Attributes:
        image_hw: Pixels of a camera.
        stem: Channels of the first stage of the backbone.
        strides: Of the feature levels.
        grid: Cells of the bird's eye view.
        upsampled: By which the heads behind tracking see the view enlarged.
        classes: Of objects.
        queries: New track queries a frame, the last of which is the ego vehicle's.
        tracks: Slots for tracks that survive a frame.
        encoder_layers: Of the BEV encoder.
        decoder_layers: Of the track decoder, and of both halves of the map head.
        map_queries: Lanes.
    """

    image_hw: tuple[int, int] = (928, 1600)
    stem: int = 64
    strides: tuple[int, ...] = (8, 16, 32, 64)
    grid: BevGrid = GRID
    upsampled: int = 2
    classes: int = 9
    queries: int = 901
    tracks: int = 249
    encoder_layers: int = 3
    decoder_layers: int = 6
    map_queries: int = 300

    @property
    def hws(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of the feature levels of a camera."""
        height, width = self.image_hw
        return tuple((-(-height // each), -(-width // each)) for each in self.strides)

    @property
    def head_hw(self) -> tuple[int, int]:
        """Rows and columns of the enlarged view."""
        rows, columns = self.grid.hw
        return rows * self.upsampled, columns * self.upsampled
