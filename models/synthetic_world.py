"""A small world: a curved road with markings, moving vehicles, static objects."""

import math
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.floating[Any]]

FRAME_S = 0.5
"""Seconds between frames, nuScenes' key frames and the plan's waypoints."""

LANE_M = 3.5
LANES = 3
LINE_M = 0.15
DASH_M, DASH_PERIOD_M = 3.0, 9.0
TILE = 256
TILE_CELL_M = 0.25

GRASS = np.array([92.0, 118.0, 74.0], np.float32)
PAVEMENT = np.array([150.0, 146.0, 140.0], np.float32)
ASPHALT = np.array([84.0, 85.0, 90.0], np.float32)
PAINT = np.array([228.0, 228.0, 222.0], np.float32)
GLASS = np.array([36.0, 44.0, 54.0], np.float32)


@dataclass(frozen=True)
class EgoPose:
    """A pose in metres and radians; yaw 0 looks along x, left is positive."""

    x: float
    y: float
    yaw: float

    def to_world(self, right: Array, ahead: Array) -> tuple[Array, Array]:
        """Convert lidar frame (x right, y forward) to world."""
        cos, sin = np.float32(math.cos(self.yaw)), np.float32(math.sin(self.yaw))
        x = np.float32(self.x) + cos * ahead + sin * right
        y = np.float32(self.y) + sin * ahead - cos * right
        return x, y

    def to_lidar(self, x: float | Array, y: float | Array) -> tuple[Array, Array]:
        """Convert world to lidar frame (x right, y forward)."""
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        dx, dy = np.asarray(x) - self.x, np.asarray(y) - self.y
        right, ahead = sin * dx - cos * dy, cos * dx + sin * dy
        return right.astype(np.float32), ahead.astype(np.float32)


@dataclass(frozen=True)
class Cuboid:
    """A box in metres, radians and RGB; ``window_m`` is a dark band's period."""

    x: float
    y: float
    yaw: float
    length: float
    width: float
    height: float
    colour: tuple[float, float, float]
    speed_mps: float = 0.0
    window_m: float | None = None

    def moved(self, seconds: float) -> "Cuboid":
        """Return the box after driving straight on for some seconds."""
        way = self.speed_mps * seconds
        return replace(
            self,
            x=self.x + way * math.cos(self.yaw),
            y=self.y + way * math.sin(self.yaw),
        )

    def corners(self) -> tuple[Array, Array, Array]:
        """Return world x, y and height above the ground of the 8 corners."""
        signs = np.array([(i, j, k) for i in (-1, 1) for j in (-1, 1) for k in (0, 1)])
        a, b = signs[:, 0] * self.length / 2, signs[:, 1] * self.width / 2
        cos, sin = math.cos(self.yaw), math.sin(self.yaw)
        x, y = self.x + cos * a - sin * b, self.y + sin * a + cos * b
        return (
            x.astype(np.float32),
            y.astype(np.float32),
            (signs[:, 2] * self.height).astype(np.float32),
        )

    def paint(
        self, at: Array, half: Array, axis: NDArray[np.intp], sun: Array
    ) -> Array:
        """Return the colours [N, 3], RGB, of points ``at`` [N, 3] on the surface.

        Points, half sizes ``half`` [3] and the direction ``sun`` [3] are in the frame
        of the box (length, width, height); ``axis`` [N] is the axis of the face that
        was hit.
        """
        rows = np.arange(len(at))
        side = np.sign(at[rows, axis])
        shade = 0.62 + 0.38 * np.clip(side * sun[axis], 0, 1)
        colour = np.array(self.colour, np.float32) * shade[:, None]
        if self.window_m is not None:
            level = (at[:, 2] + half[2]) / self.window_m % 1.0
            along = at[rows, np.where(axis == 0, 1, 0)] / self.window_m % 1.0
            glass = (axis < 2) & (level > 0.5) & (level < 0.85) & (along > 0.15)
            colour[glass] = GLASS
        return colour.astype(np.float32)


@dataclass(frozen=True)
class SyntheticWorld:
    """The ground, and the objects on it when the scene began.

    The middle of the road is y = bend * x ** 2 / 2, a zebra crossing begins at
    ``crossing_m``, and ``tile`` [256, 256] is the repeated brightness of the ground.
    ``lane_m`` is the ego vehicle's offset from the middle, left positive.
    """

    bend: float
    crossing_m: float
    tile: Array
    boxes: tuple[Cuboid, ...]
    speed_mps: float
    accel_mps2: float
    lane_m: float

    def ego(self, seconds: float) -> EgoPose:
        """Return the pose of the ego vehicle, which keeps its lane."""
        way = self.speed_mps * seconds + self.accel_mps2 * seconds**2 / 2
        return EgoPose(
            way,
            self.bend * way**2 / 2 + self.lane_m,
            math.atan(self.bend * way),
        )

    def boxes_at(self, seconds: float) -> tuple[Cuboid, ...]:
        """Return all boxes at a time."""
        return tuple(box.moved(seconds) for box in self.boxes)

    def ground(self, x: Array, y: Array) -> Array:
        """Return the colour [..., 3] of the ground at world positions in metres."""
        # Distance from the middle of the road
        aside = y - self.bend * x * x / 2
        away = np.abs(aside)
        edge = LANES * LANE_M / 2
        colour = np.where((away < edge + 2.5)[..., None], PAVEMENT, GRASS)
        road = away < edge
        colour[road] = ASPHALT
        # Lines and the zebra crossing
        solid = np.abs(away - edge + 0.3) < LINE_M
        divider = np.abs(away - LANE_M / 2) < LINE_M / 2
        dashed = divider & (x % DASH_PERIOD_M < DASH_M)
        zebra = (np.abs(x - self.crossing_m) < 1.5) & (aside % 1.0 < 0.5) & road
        colour[solid | dashed | zebra] = PAINT
        # Brightness varies by a repeated tile
        column = (x / TILE_CELL_M).astype(np.int32) % TILE
        row = (y / TILE_CELL_M).astype(np.int32) % TILE
        return colour + self.tile[row, column][..., None]


Range = tuple[float, float]

TINT = 22.0
"""Standard deviation of a colour around its grey, in 1 / 255."""


def draw_world(rng: np.random.Generator) -> SyntheticWorld:
    """Draw a road with 8 to 12 vehicles, parked cars, buildings, people and cones."""
    bend = float(rng.uniform(-0.008, 0.008))
    speed_mps = float(rng.uniform(3, 10))
    # Objects by kind
    boxes = [
        *(_vehicle(rng, bend, speed_mps) for _ in range(int(rng.integers(8, 13)))),
        *(_parked(rng, bend) for _ in range(int(rng.integers(4, 8)))),
        *(_building(rng, bend) for _ in range(int(rng.integers(10, 15)))),
        *(_small(rng, bend) for _ in range(int(rng.integers(5, 9)))),
    ]
    # Ground texture of two scales
    coarse = rng.normal(0, 7, (TILE // 8, TILE // 8)).repeat(8, 0).repeat(8, 1)
    tile = (coarse + rng.normal(0, 6, (TILE, TILE))).astype(np.float32)
    return SyntheticWorld(
        bend=bend,
        crossing_m=float(rng.uniform(8, 40)),
        tile=tile,
        boxes=tuple(boxes),
        speed_mps=speed_mps,
        accel_mps2=float(rng.uniform(-0.7, 0.7)),
        lane_m=0.0,
    )


def _place(bend: float, along: float, aside: float) -> tuple[float, float, float]:
    """Return world x, y and yaw at a station and an offset of the road."""
    return along, bend * along**2 / 2 + aside, math.atan(bend * along)


def _colour(rng: np.random.Generator, bounds: Range) -> tuple[float, float, float]:
    red, green, blue = np.clip(rng.uniform(*bounds) + rng.normal(0, TINT, 3), 0, 255)
    return float(red), float(green), float(blue)


def _vehicle(rng: np.random.Generator, bend: float, ego_mps: float) -> Cuboid:
    """Draw a moving vehicle; in the ego's lane it is about as fast as the ego."""
    # Keep a gap around the ego vehicle in its lane
    lane = int(rng.integers(0, LANES)) - LANES // 2
    ahead = lane != 0 or rng.random() < 0.7
    along = float(rng.uniform(9, 60) if ahead else rng.uniform(-50, -9))
    if lane != 0:
        along = float(rng.uniform(-45, 60))
    x, y, yaw = _place(bend, along, lane * LANE_M)
    # A fifth of the vehicles are trucks
    truck = rng.random() < 0.2
    return Cuboid(
        x=x,
        y=y,
        yaw=yaw + (math.pi if lane == 1 else 0.0),
        length=float(rng.uniform(6.5, 9.5) if truck else rng.uniform(3.8, 4.9)),
        width=2.3 if truck else float(rng.uniform(1.7, 1.95)),
        height=float(rng.uniform(2.6, 3.4) if truck else rng.uniform(1.4, 1.8)),
        colour=_colour(rng, (30, 235)),
        speed_mps=ego_mps if lane == 0 else float(rng.uniform(4, 11)),
        window_m=None if truck else 1.6,
    )


def _parked(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    x, y, yaw = _place(bend, float(rng.uniform(-35, 55)), side * 6.4)
    return Cuboid(x, y, yaw, 4.4, 1.8, 1.5, _colour(rng, (30, 235)), window_m=1.5)


def _building(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    depth = float(rng.uniform(7, 14))
    offset = side * (float(rng.uniform(11, 20)) + depth / 2)
    x, y, yaw = _place(bend, float(rng.uniform(-55, 80)), offset)
    length, height = float(rng.uniform(9, 24)), float(rng.uniform(5, 17))
    return Cuboid(
        x, y, yaw, length, depth, height, _colour(rng, (90, 210)), window_m=2.8
    )


def _small(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    x, y, yaw = _place(bend, float(rng.uniform(-20, 40)), side * rng.uniform(6, 8.5))
    if rng.random() < 0.4:
        return Cuboid(x, y, yaw, 0.4, 0.4, 0.8, (236.0, 108.0, 32.0))
    pace = float(rng.uniform(0.6, 1.6))
    return Cuboid(x, y, yaw, 0.5, 0.5, 1.75, _colour(rng, (30, 220)), speed_mps=pace)
