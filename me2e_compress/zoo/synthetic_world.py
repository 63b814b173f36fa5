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
