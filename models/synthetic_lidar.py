"""What a LiDAR sees of the synthetic world, as a raster of the bird's eye view."""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.lead.config import CELLS_PER_M, METRES_BEHIND
from models.synthetic_cameras import LIDAR_HEIGHT_M
from models.synthetic_world import Cuboid, EgoPose

Array = NDArray[np.floating[Any]]

BEAMS_DEG = (-25.0, 10.0, 64)
"""First and last elevation, and number of beams: CARLA's LiDAR as LEAD mounts it has
64; one turn of it, not the ten that the original adds up."""

AZIMUTHS = 1440
REACH_M = 120.0
RANGE_NOISE_M = 0.03

MOST_POINTS = 5
"""A cell with as many points or more is 1."""


def raster(
    ego: EgoPose,
    boxes: Sequence[Cuboid],
    hw: Sequence[int],
    noise: np.random.Generator,
) -> NDArray[np.float32]:
    """Return the share of `MOST_POINTS` in each cell, [h, w] from 0 to 1.

    Rows go to the right, the vehicle in the middle; columns ahead, a third of them
    behind the vehicle.
    """
    right, ahead = _points(ego, boxes, noise)
    rows, columns = hw
    row = np.floor(right * CELLS_PER_M + rows / 2).astype(np.int64)
    column = np.floor(ahead * CELLS_PER_M + columns * METRES_BEHIND).astype(np.int64)
    inside = (row >= 0) & (row < rows) & (column >= 0) & (column < columns)
    cells = row[inside] * columns + column[inside]
    counts = np.bincount(cells, minlength=rows * columns).reshape(hw)
    return (np.minimum(counts, MOST_POINTS) / MOST_POINTS).astype(np.float32)


def _points(
    ego: EgoPose, boxes: Sequence[Cuboid], noise: np.random.Generator
) -> tuple[Array, Array]:
    """Return metres to the right and ahead of what each ray hits first, if anything."""
    azimuths = np.arange(AZIMUTHS) * (2 * math.pi / AZIMUTHS)
    slopes = np.tan(np.radians(np.linspace(*BEAMS_DEG)))[:, None]
    # The ground, where a beam goes down
    with np.errstate(divide="ignore"):
        ground = np.where(slopes < 0, -LIDAR_HEIGHT_M / slopes, np.inf)
    reach = np.repeat(ground, AZIMUTHS, 1)
    # The nearest box that is as high as the beam where it enters
    for box in boxes:
        entry = _entry(box, ego, azimuths)
        with np.errstate(invalid="ignore"):
            height = LIDAR_HEIGHT_M + slopes * entry
            hit = (height >= 0) & (height <= box.height)
        reach = np.where(hit, np.minimum(reach, entry), reach)
    reach = reach + noise.normal(0, RANGE_NOISE_M, reach.shape)
    seen = reach < REACH_M
    reach, at = reach[seen], np.broadcast_to(azimuths, reach.shape)[seen]
    return reach * np.sin(at), reach * np.cos(at)


def _entry(box: Cuboid, ego: EgoPose, azimuths: Array) -> Array:
    """Return metres to where each ray from the LiDAR enters a box, else infinity."""
    # Rays in the frame of the box, by slabs as the cameras do
    right, ahead = ego.to_lidar(box.x, box.y)
    turn = ego.yaw - box.yaw
    cos, sin = math.cos(turn), math.sin(turn)
    origin = np.array([-(cos * ahead + sin * right), -(sin * ahead - cos * right)])
    towards = np.stack([np.cos(azimuths - turn), -np.sin(azimuths - turn)])
    half = np.array([box.length / 2, box.width / 2])
    with np.errstate(divide="ignore", invalid="ignore"):
        one = (-half - origin)[:, None] / towards
        other = (half - origin)[:, None] / towards
    near = np.minimum(one, other).max(0)
    far = np.maximum(one, other).min(0)
    entry: Array = np.where((near < far) & (near > 0), near, np.inf)
    return entry
