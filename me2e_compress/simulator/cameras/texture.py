"""The ground of one route as a picture from above, painted once.

Two rasters of the same grid, north up: colours with mip levels, and classes. The
classes are painted beside the colours, stroke by stroke, never read off them.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import SUBPIXEL_BITS, fixed_point
from me2e_compress.simulator.cameras.classes import PixelClass
from me2e_compress.simulator.plane_geometry import LaneMarking, Roadmap, resample

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Colour = tuple[int, int, int]

ASPHALT = (98, 98, 101)
SHOULDER = (116, 112, 105)
KERB = (138, 134, 124)
WHITE = (238, 238, 238)
KERB_M = 0.3
"""A lighter rim around all pavement: where the road ends is seen without a line."""
LINE_M = 0.2
"""A little wider than the 0.15 m of real lines: our images are small."""
DASH_M, DASH_PERIOD_M, DASH_STEP_M = 3.0, 9.0, 0.5
"""3 m painted, 6 m free, from the start of the lane: the pattern of highway-env."""
STOP_LINE_M = 0.5
BAR_M, BAR_PERIOD_M = 0.5, 1.0
"""Zebra bars."""


@dataclass(frozen=True, eq=False)
class GroundPlan:
    """The two rasters while they are painted, and where they lie in the world."""

    west_m: float
    north_m: float
    colours: Bytes
    classes: Bytes

    def texels(self, points: Floats) -> Floats:
        """Convert world points [..., 2] to continuous texels (column, row)."""
        offset = np.asarray(points) - (self.west_m, self.north_m)
        return np.asarray(offset * (1.0, -1.0) / RESOLUTION_M)

    def near(self, points: Floats) -> bool:
        """Return whether a polyline may touch the rasters."""
        height, width = self.classes.shape
        low, high = (f(self.texels(points), axis=0) for f in (np.min, np.max))
        return bool((high > -width).all() and (low < (2 * width, 2 * height)).all())

    def strip(
        self, line: Floats, width_m: float, colour: Colour, kind: PixelClass
    ) -> None:
        """Paint a band along a polyline [N, 2] of world points.

        Piece by piece, since cv2 paints convex polygons without bias and others not.
        Antialiased, it rounds them out by half a texel on each side: taken off here.
        """
        normals = left_of(line)
        aliased = self._quads(line, normals, width_m)
        smooth = self._quads(line, normals, width_m - RESOLUTION_M)
        for sharp, soft in zip(aliased, smooth, strict=True):
            cv2.fillConvexPoly(
                self.classes, sharp, (int(kind),), cv2.LINE_8, SUBPIXEL_BITS
            )
            cv2.fillConvexPoly(self.colours, soft, colour, cv2.LINE_AA, SUBPIXEL_BITS)

    def _quads(
        self, line: Floats, normals: tuple[Floats, Floats], width_m: float
    ) -> npt.NDArray[np.int32]:
        """Return [N - 1, 4, 2], the pieces of a band."""
        normal, length = normals
        sides = (line + normal * (side * width_m / length) for side in (0.5, -0.5))
        left, right = (fixed_point(self.texels(side)) for side in sides)
        return np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=1)


def offset_line(line: Floats, lateral_m: float) -> Floats:
    """Return a polyline [N, 2] moved to its left."""
    normal, length = left_of(line)
    return np.asarray(line + normal * (lateral_m / length))


def left_of(line: Floats) -> tuple[Floats, Floats]:
    """Return normals [N, 2] to the left of a polyline, and their lengths [N, 1]."""
    tangent = np.gradient(line, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    return normal, np.linalg.norm(normal, axis=1)[:, None]


def paint_lanes(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint all kerbs, then shoulders, then asphalt, so that overlaps join up."""
    lanes = [lane for lane in roadmap.lanes if plan.near(lane.centre)]
    shoulders = [lane for lane in lanes if lane.shoulder]
    driven = [lane for lane in lanes if not lane.shoulder]
    layers = (
        (lanes, 2 * KERB_M, KERB, PixelClass.TERRAIN),
        (shoulders, 0.0, SHOULDER, PixelClass.SHOULDER),
        (driven, 0.0, ASPHALT, PixelClass.DRIVABLE),
    )
    for members, more_m, colour, kind in layers:
        for lane in members:
            plan.strip(lane.centre, lane.width + more_m, colour, kind)


def paint_markings(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint the left and right edges of every lane as it asks for."""
    for lane in roadmap.lanes:
        if not plan.near(lane.centre):
            continue
        for marking, side in ((lane.left, 0.5), (lane.right, -0.5)):
            edge = offset_line(lane.centre, side * lane.width)
            for line in _pieces(edge, marking):
                plan.strip(line, LINE_M, WHITE, PixelClass.LANE_MARKING)


def _pieces(edge: Floats, marking: LaneMarking) -> Iterator[Floats]:
    """Yield the polylines to paint along an edge: all of it, its dashes, or none."""
    if marking is LaneMarking.SOLID:
        yield edge
    if marking is LaneMarking.DASHED:
        dense = resample(edge, DASH_STEP_M)
        dash, period = (round(m / DASH_STEP_M) for m in (DASH_M, DASH_PERIOD_M))
        for start in range(0, len(dense) - 1, period):
            yield dense[start : start + dash + 1]


def paint_stop_lines(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint bars of 0.5 m across the lanes."""
    for ends in roadmap.stop_lines:
        plan.strip(np.array(ends, float), STOP_LINE_M, WHITE, PixelClass.STOP_LINE)


def paint_crosswalks(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint zebra bars along the traffic: parallel to the shorter sides."""
    for rectangle in roadmap.crosswalks:
        a, b, c, d = np.array(rectangle, float)
        if np.linalg.norm(b - a) < np.linalg.norm(c - b):
            a, b, c, d = b, c, d, a
        length = float(np.linalg.norm(b - a))
        for middle in np.arange(BAR_M, length - BAR_M / 2, BAR_PERIOD_M) / length:
            bar = np.array([a + middle * (b - a), d + middle * (c - d)])
            plan.strip(bar, BAR_M, WHITE, PixelClass.CROSSWALK)


RESOLUTION_M = 0.125
"""Metres of a texel at the finest level: a 0.15 m line is just wider than one."""
LEVELS = 6
MARGIN_M = 60.0
"""How far the texture reaches beyond the route's bounding box. What lies further
repeats its border, which continues a straight road."""
GRASS = (92, 122, 70)
GRASS_GRAIN, ASPHALT_GRAIN = np.float32(10.0), np.float32(3.0)
"""Grey levels of the mottling."""
GRAINS = ((16.0, 0.8), (2.0, 0.6), (0.5, 0.4))
"""Metres of a patch, and its share of the mottling."""
ROWS_AT_ONCE = 32


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

    def __post_init__(self) -> None:
        """Make the rasters read-only: many frames are sampled from them."""
        for raster in (*self.levels, self.classes):
            raster.flags.writeable = False


def paint_texture(roadmap: Roadmap, route: npt.NDArray[np.float64]) -> GroundTexture:
    """Paint lanes, markings, stop lines, crosswalks and the verge.

    The texture covers the bounding box of ``route``, [N, 2] metres, and 60 m around.
    """
    # the raster's extent
    west, south = route.min(axis=0) - MARGIN_M
    east, north = route.max(axis=0) + MARGIN_M
    height, width = (_texels(span) for span in (north - south, east - west))
    plan = GroundPlan(
        west_m=float(west),
        north_m=float(north),
        colours=np.empty((height, width, 3), np.uint8),
        classes=np.full((height, width), PixelClass.TERRAIN, np.uint8),
    )
    # from grass up: lanes, grain, then everything painted on top
    plan.colours[0] = GRASS
    plan.colours[1:] = plan.colours[0]
    paint_lanes(plan, roadmap)
    _add_grain(plan, np.random.default_rng(0))
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
    patches = np.empty((3, height, width), np.float32)
    for out, (patch_m, share) in zip(patches, GRAINS, strict=True):
        cells = int(patch_m / RESOLUTION_M)
        coarse = rng.uniform(-share, share, (height // cells + 2, width // cells + 2))
        cv2.resize(coarse.astype(np.float32), (width, height), out)
    # a few rows at a time stay in the processor's cache
    for top in range(0, height, ROWS_AT_ONCE):
        rows = slice(top, top + ROWS_AT_ONCE)
        grass = plan.classes[rows] == PixelClass.TERRAIN
        grain = patches[0, rows] + patches[1, rows] + patches[2, rows]
        step = np.rint(grain * np.where(grass, GRASS_GRAIN, ASPHALT_GRAIN))
        mottled = cv2.merge([step.astype(np.int16)] * 3)
        cv2.add(plan.colours[rows], mottled, plan.colours[rows], dtype=cv2.CV_8U)


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
