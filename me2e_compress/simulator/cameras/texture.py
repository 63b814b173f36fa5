"""The ground of one route as a picture from above, painted once.

Two rasters of the same grid, north up: colours with mip levels, and classes. The
classes are painted beside the colours, stroke by stroke, never read off them.
"""

from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras.classes import PixelClass
from me2e_compress.simulator.cameras.strokes import (
    GroundPlan,
    paint_crosswalks,
    paint_lanes,
    paint_markings,
    paint_stop_lines,
)
from me2e_compress.simulator.scene import Roadmap

Bytes = npt.NDArray[np.uint8]

RESOLUTION_M = 0.125
"""Metres of a texel at the finest level: a 0.15 m line is just wider than one."""
LEVELS = 6
MARGIN_M = 60.0
"""How far the texture reaches beyond the route's bounding box. What lies further
repeats its border, which continues a straight road."""
GRASS = (92, 122, 70)
GRASS_GRAIN, ASPHALT_GRAIN = np.float32(10.0), np.float32(3.0)
"""Grey levels of the mottling."""


@dataclass(frozen=True, eq=False)
class GroundTexture:
    """The painted ground around a route.

    Attributes:
        west_m: World x of the left edge of the raster.
        north_m: World y of its upper edge.
        levels: Mip levels, finest first, uint8 [H, W, 4]: RGB and an unused fourth
            channel, which makes sampling twice as fast.
        classes: uint8 [H, W] of `PixelClass`, on the finest grid.
    """

    west_m: float
    north_m: float
    levels: tuple[Bytes, ...]
    classes: Bytes

    @property
    def nbytes(self) -> int:
        """Memory of all rasters in bytes."""
        return self.classes.nbytes + sum(level.nbytes for level in self.levels)

    def __post_init__(self) -> None:
        """Make the rasters read-only: many frames are sampled from them."""
        for raster in (*self.levels, self.classes):
            raster.flags.writeable = False


def paint_texture(
    roadmap: Roadmap, route: npt.NDArray[np.float64], *, seed: int = 0
) -> GroundTexture:
    """Paint lanes, markings, stop lines, crosswalks and the verge.

    The texture covers the bounding box of ``route``, [N, 2] metres, and 60 m around.
    ``seed`` is that of the grain of grass and asphalt.
    """
    # the raster's extent
    west, south = route.min(axis=0) - MARGIN_M
    east, north = route.max(axis=0) + MARGIN_M
    height, width = (_texels(span) for span in (north - south, east - west))
    plan = GroundPlan(
        west_m=float(west),
        north_m=float(north),
        resolution_m=RESOLUTION_M,
        colours=np.empty((height, width, 3), np.uint8),
        classes=np.full((height, width), PixelClass.TERRAIN, np.uint8),
    )
    # from grass up: lanes, grain, then everything painted on top
    plan.colours[:] = GRASS
    paint_lanes(plan, roadmap)
    _add_grain(plan, np.random.default_rng(seed))
    paint_markings(plan, roadmap)
    paint_stop_lines(plan, roadmap)
    paint_crosswalks(plan, roadmap)
    return GroundTexture(
        plan.west_m, plan.north_m, _mip_levels(plan.colours), plan.classes
    )


def _texels(span_m: float) -> int:
    """Return the whole texels of a span, divisible down to the coarsest level."""
    coarsest = 1 << (LEVELS - 1)
    return int(np.ceil(span_m / RESOLUTION_M / coarsest)) * coarsest


def _add_grain(plan: GroundPlan, rng: np.random.Generator) -> None:
    """Mottle grass strongly and pavement faintly, in patches of 16, 2 and 0.5 m."""
    height, width = plan.classes.shape
    grain = np.zeros((height, width), np.float32)
    for patch_m, share in ((16.0, 0.8), (2.0, 0.6), (0.5, 0.4)):
        cells = int(patch_m / RESOLUTION_M)
        coarse = rng.uniform(-share, share, (height // cells + 2, width // cells + 2))
        grain += cv2.resize(coarse.astype(np.float32), (width, height))
    grain *= np.where(plan.classes == PixelClass.TERRAIN, GRASS_GRAIN, ASPHALT_GRAIN)
    step = np.rint(grain).astype(np.int16)
    cv2.add(plan.colours, cv2.merge([step] * 3), plan.colours, dtype=cv2.CV_8U)


def _mip_levels(colours: Bytes) -> tuple[Bytes, ...]:
    """Halve again and again: sizes are divisible, so texels nest exactly."""
    levels = [np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2RGBA), np.uint8)]
    for _ in range(LEVELS - 1):
        height, width = levels[-1].shape[:2]
        half = cv2.resize(
            levels[-1], (width // 2, height // 2), interpolation=cv2.INTER_AREA
        )
        levels.append(np.asarray(half, np.uint8))
    return tuple(levels)
