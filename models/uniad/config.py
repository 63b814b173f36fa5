"""Dimensions of UniAD-tiny in Bench2DriveZoo and in DL4AGX."""

from dataclasses import dataclass

from models.bev.sizes import BevGrid

AGENT_MODES = 6
AGENT_STEPS = 12
PLAN_STEPS = 6
"""Steps of 0.5 s each."""

MEMORY = 4
"""Number of past embeddings kept per track."""

OCC_REACH_M = 50.0
"""Half the side of the square in which occupancy is predicted."""

RANGE = (-51.2, -51.2, -5.0, 51.2, 51.2, 3.0)

GRID = BevGrid((100, 100), RANGE, (100.0, 100.0))
"""Of Bench2DriveZoo, whose previous view turns about a corner (see `vad.config`)."""


@dataclass(frozen=True)
class DatasetClasses:
    """Classes of a data set, and other differences between data sets.

    Attributes:
        groups: the group of motion anchors of every object class.
        vehicles: classes whose occupancy is predicted.
        things: number of map classes that are instances.
        commands: number of navigation commands.
    """

    groups: tuple[int, ...]
    vehicles: tuple[int, ...]
    things: int
    commands: int

    @property
    def classes(self) -> int:
        """The number of object classes."""
        return len(self.groups)


BENCH2DRIVE = DatasetClasses((0, 0, 0, 1, 0, 0, 0, 2, 0), (0, 1, 2, 3, 4, 6, 7), 6, 6)
"""Car, van, truck, bicycle, sign, cone, light, pedestrian, others; the groups are
vehicles (and whatever has no group of its own), bicycles, pedestrians. Its tiny
configuration leaves the vehicles at nuScenes' default."""

NUSCENES = DatasetClasses((0, 0, 0, 0, 0, 3, 1, 1, 2, 3), (0, 1, 2, 3, 4, 6, 7), 3, 3)
"""Car, truck, construction vehicle, bus, trailer, barrier, motorcycle, bicycle,
pedestrian, cone."""


@dataclass(frozen=True)
class UniadConfig:
    """Sizes of UniAD; the defaults are Bench2DriveZoo's.

    Attributes:
        image_hw: pixels of a camera.
        stem: channels of the first stage of the backbone.
        stages: stages of the backbone that the neck reads, from 0.
        strides: of the feature levels.
        grid: cells of the bird's eye view.
        upsampled: scale of the view for the heads after tracking.
        labels: of the data set.
        queries: new track queries per frame, the last of which is the ego vehicle's.
        tracks: slots for tracks that survive a frame: with the new queries 1150,
            DL4AGX's maximum.
        encoder_layers: of the BEV encoder.
        decoder_layers: of the track decoder, and of both halves of the map head.
        map_queries: number of lanes.
        map_levels: levels for which the published map attention has weights; it reads
            one.
    """

    image_hw: tuple[int, int] = (928, 1600)
    stem: int = 64
    stages: tuple[int, ...] = (1, 2, 3)
    strides: tuple[int, ...] = (8, 16, 32, 64)
    grid: BevGrid = GRID
    upsampled: int = 2
    labels: DatasetClasses = BENCH2DRIVE
    queries: int = 901
    tracks: int = 249
    encoder_layers: int = 3
    decoder_layers: int = 6
    map_queries: int = 300
    map_levels: int = 4

    @property
    def hws(self) -> tuple[tuple[int, int], ...]:
        """Rows and columns of the feature levels of a camera."""
        height, width = self.image_hw
        return tuple((-(-height // each), -(-width // each)) for each in self.strides)

    @property
    def head_hw(self) -> tuple[int, int]:
        """Rows and columns of the upsampled view."""
        rows, columns = self.grid.hw
        return rows * self.upsampled, columns * self.upsampled


PUBLISHED = UniadConfig()
"""Bench2DriveZoo, adzoo/uniad/configs/stage2_e2e/tiny_e2e_b2d.py."""

DL4AGX = UniadConfig(
    image_hw=(256, 416),
    stages=(3,),
    strides=(32,),
    grid=BevGrid((50, 50), RANGE, (100.0, 100.0)),
    upsampled=1,
    labels=NUSCENES,
    map_levels=1,
)
"""NVIDIA/DL4AGX, uniad-trt: smaller images, one feature level, 50 x 50 cells."""

CONFIGS = {"uniad-tiny": PUBLISHED, "uniad-trt": DL4AGX}
"""By the name of the stack."""
