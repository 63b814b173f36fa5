"""The ground of one route as a picture from above, painted once.

Two rasters of the same grid, north up: colours with mip levels, and classes. The
classes are painted beside the colours, stroke by stroke, never read off them.
"""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import (
    CAMERA_HEIGHT_M,
    SUBPIXEL_BITS,
    CameraRig,
    fixed_point,
)
from me2e_compress.simulator.plane_geometry import (
    Floats,
    LaneMarking,
    Roadmap,
    resample,
)
from me2e_compress.simulator.scene import Ego, PixelClass

Bytes = npt.NDArray[np.uint8]
Floats32 = npt.NDArray[np.float32]
Colour = tuple[int, int, int]

ASPHALT = (98, 98, 101)
SHOULDER = (116, 112, 105)
KERB = (138, 134, 124)
WHITE = (238, 238, 238)
KERB_M = 0.3  # a lighter rim around all pavement: the road's end without a line
LINE_M = 0.2  # a little wider than the 0.15 m of real lines: our images are small
DASH_M, DASH_PERIOD_M, DASH_STEP_M = 3.0, 9.0, 0.5  # as in highway-env
STOP_LINE_M = 0.5
BAR_M, BAR_PERIOD_M = 0.5, 1.0  # zebra bars
RESOLUTION_M = 0.125  # of a texel at the finest level: a line is just wider
LEVELS = 6
# How far the texture reaches beyond the route's bounding box. What lies further repeats
# its border, which continues a straight road.
MARGIN_M = 60.0
GRASS = (92, 122, 70)
GRASS_GRAIN, ASPHALT_GRAIN = np.float32(10.0), np.float32(3.0)  # in grey levels
GRAINS = ((16.0, 0.8), (2.0, 0.6), (0.5, 0.4))  # metres of a patch, share of mottling
ROWS_AT_ONCE = 32
FARTHEST_M = 400.0  # depth of the last row before the horizon, at most
SKY_M = 4000.0  # the sky counts as this far away
TAPS = ((0.0, 1), (10.0, 4))  # samples of a row, from these depths (m) on
# A mip level is chosen whose texel is this part of a sample's length on the ground:
# less shimmers, more blurs
BLUR = 0.5


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
        """Paint a band along a polyline [N, 2] of world points."""
        # Piece by piece: cv2 fills convex polygons without bias, and no others.
        # Antialiasing widens a polygon by half a texel on each side, so the colours'
        # band is narrower by one texel.
        normal, length = left_of(line)
        bands = []
        for metres in (width_m, width_m - RESOLUTION_M):
            sides = (line + normal * (side * metres / length) for side in (0.5, -0.5))
            left, right = (fixed_point(self.texels(side)) for side in sides)
            bands.append(np.stack([left[:-1], right[:-1], right[1:], left[1:]], axis=1))
        fill, label = cv2.fillConvexPoly, (int(kind),)
        for sharp, soft in zip(*bands, strict=True):
            fill(self.classes, sharp, label, cv2.LINE_8, SUBPIXEL_BITS)
            fill(self.colours, soft, colour, cv2.LINE_AA, SUBPIXEL_BITS)


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
            # all of an edge, its dashes, or none
            normal, length = left_of(lane.centre)
            edge = np.asarray(lane.centre + normal * (side * lane.width / length))
            lines = [edge] if marking is LaneMarking.SOLID else []
            if marking is LaneMarking.DASHED:
                dense = resample(edge, DASH_STEP_M)
                dash, period = (round(m / DASH_STEP_M) for m in (DASH_M, DASH_PERIOD_M))
                starts = range(0, len(dense) - 1, period)
                lines = [dense[start : start + dash + 1] for start in starts]
            for line in lines:
                plan.strip(line, LINE_M, WHITE, PixelClass.LANE_MARKING)


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


@dataclass(frozen=True, eq=False)
class GroundTexture:
    """The painted ground around a route."""

    west_m: float  # world x of the raster's left edge
    north_m: float  # world y of its upper edge
    # Mip levels, finest first, (rows, columns, 4): RGB and an unused channel, which
    # makes sampling twice as fast
    levels: tuple[Bytes, ...]
    classes: Bytes  # (rows, columns) of `PixelClass`, on the finest grid

    def __post_init__(self) -> None:
        # Many frames are sampled from the rasters: nobody may change them
        for raster in (*self.levels, self.classes):
            raster.flags.writeable = False


def paint_texture(roadmap: Roadmap, route: Floats) -> GroundTexture:
    """Paint all within 60 m of the bounding box of ``route``, [N, 2] metres."""
    # The raster's extent
    west, south = route.min(axis=0) - MARGIN_M
    east, north = route.max(axis=0) + MARGIN_M
    # Whole texels, divisible down to the coarsest level
    coarsest = 1 << (LEVELS - 1)
    height, width = (
        int(np.ceil(span / RESOLUTION_M / coarsest)) * coarsest
        for span in (north - south, east - west)
    )
    colours = np.empty((height, width, 3), np.uint8)
    classes = np.full((height, width), PixelClass.TERRAIN, np.uint8)
    plan = GroundPlan(float(west), float(north), colours, classes)
    # Paint from the grass up: lanes, grain, then everything on top
    colours[0] = GRASS
    colours[1:] = colours[0]
    paint_lanes(plan, roadmap)
    _add_grain(plan, np.random.default_rng(0))
    paint_markings(plan, roadmap)
    for ends in roadmap.stop_lines:
        plan.strip(np.array(ends, float), STOP_LINE_M, WHITE, PixelClass.STOP_LINE)
    paint_crosswalks(plan, roadmap)
    # Mip levels: halve again and again; sizes are divisible, so texels nest exactly
    levels = [np.asarray(cv2.cvtColor(colours, cv2.COLOR_RGB2RGBA), np.uint8)]
    for k in range(1, LEVELS):
        size, how = (width >> k, height >> k), cv2.INTER_AREA
        half = cv2.resize(levels[-1], size, interpolation=how)
        levels.append(np.asarray(half, np.uint8))
    return GroundTexture(plan.west_m, plan.north_m, tuple(levels), classes)


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


# The ground in all six cameras: rows of the texture, sampled anew each frame. A camera
# without pitch and roll sees, in each of its rows, a straight segment of the ground at
# constant depth. So one row of an image is a point and a step in the ego frame; both
# turn and move with the ego, and the pixels of all rows of all cameras are one outer
# product. Rows far away are short in the image and long on the ground: they are sampled
# several times, which keeps distant lines from flickering.


@dataclass(frozen=True, eq=False)
class RowGroup:
    """Rows of the six images that are sampled alike, sorted by mip level."""

    rows: npt.NDArray[np.intp]  # (rows,) index into the stacked images, (6 * height,)
    origins: Floats  # (taps, rows, 2) ground point left of column 0 (m, ego frame)
    steps: Floats  # (taps, rows, 2) metres from one column to the next
    levels: npt.NDArray[np.intp]  # (rows,) mip level
    blocks: tuple[tuple[int, int, int], ...]  # (level, first, last): slices of rows
    # Working memory, overwritten in every frame
    coordinates: tuple[Floats32, Floats32]  # (rows, taps, width) each
    samples: Bytes  # (rows, taps, width, 4)


@dataclass(frozen=True, eq=False)
class GroundSampler:
    """Draws the ground of a rig from a texture, on one thread at a time."""

    rig: CameraRig

    def paint(self, images: Bytes, texture: GroundTexture, ego: Ego) -> None:
        """Fill the ground rows of uint8 [6, H, W, 3]."""
        stacked = images.reshape(-1, *images.shape[2:])
        for group in self._groups:
            u, v = self._coordinates(group, texture, ego)
            taps = group.samples
            # sample every row from its own mip level, then average
            for level, first, last in group.blocks:
                cv2.remap(
                    texture.levels[level],
                    u[first:last].reshape(-1, self.rig.width),
                    v[first:last].reshape(-1, self.rig.width),
                    cv2.INTER_LINEAR,
                    dst=taps[first:last].reshape(-1, *taps.shape[2:]),
                    borderMode=cv2.BORDER_REPLICATE,
                )
            # 1, 2 or 4 samples, pair by pair
            means: list[Bytes] = list(taps.swapaxes(0, 1))
            while len(means) > 1:
                means = [
                    np.asarray(cv2.addWeighted(a, 0.5, b, 0.5, 0.0), np.uint8)
                    for a, b in zip(means[::2], means[1::2], strict=True)
                ]
            stacked[group.rows] = cv2.cvtColor(means[0], cv2.COLOR_RGBA2RGB)

    @cached_property
    def places(self) -> Floats:
        """[6, H, W, 2] ground points of all pixels, ego frame; sky far off."""
        depth = np.minimum(row_depths(self.rig, 1)[0], SKY_M)[..., None, None]
        column = np.arange(self.rig.width) + 0.5 - self.rig.centre_px[0]
        tangent = (column / self.rig.focals_px[:, None])[:, None, :, None]
        right, forward = (self.rig.rotations[:, i, None, None, :2] for i in (0, 2))
        position = self.rig.positions[:, None, None, :2]
        return np.asarray(position + depth * (forward + tangent * right))

    def _coordinates(
        self, group: RowGroup, texture: GroundTexture, ego: Ego
    ) -> tuple[Floats32, Floats32]:
        """Return [R, T, W] texture columns and rows, each on its own mip level."""
        cos, sin = np.cos(ego.heading), np.sin(ego.heading)
        # ego frame to metres right and down from the texture's corner: rows run south
        rotation = np.array([[cos, -sin], [-sin, -cos]])
        corner = np.array([ego.x - texture.west_m, texture.north_m - ego.y])
        scale = 1.0 / (RESOLUTION_M * 2.0**group.levels)
        start = (group.origins @ rotation.T + corner) * scale[:, None] - 0.5
        step = (group.steps @ rotation.T) * scale[:, None]
        # [R, T, 2] as the pixels lie
        start32, step32 = (e.astype(np.float32).swapaxes(0, 1) for e in (start, step))
        column = np.arange(self.rig.width, dtype=np.float32) + np.float32(0.5)
        for i, pixels in enumerate(group.coordinates):
            np.multiply(step32[..., i, None], column, out=pixels)
            pixels += start32[..., i, None]
        return group.coordinates

    @cached_property
    def _groups(self) -> tuple[RowGroup, ...]:
        depths = row_depths(self.rig, 1)[0]
        limits = [*(depth for depth, _ in TAPS), np.inf]
        groups = list[RowGroup]()
        for (_, taps), low, high in zip(TAPS, limits[:-1], limits[1:], strict=True):
            camera, row = np.nonzero((depths >= low) & (depths < high))
            if len(row):
                groups.append(self._group(camera, row, taps))
        return tuple(groups)

    def _group(
        self, camera: npt.NDArray[np.intp], row: npt.NDArray[np.intp], taps: int
    ) -> RowGroup:
        # The mip level at which neither columns nor samples skip texels
        depth = row_depths(self.rig, 1)[0, camera, row]
        across = depth / self.rig.focals_px[camera]
        along = across * depth / CAMERA_HEIGHT_M / taps
        texels = np.maximum(across, BLUR * along) / RESOLUTION_M
        levels = np.clip(np.log2(texels).astype(np.intp), 0, LEVELS - 1)
        # Sort the rows by level, so that each level is one slice
        order = np.argsort(levels, kind="stable")
        camera, row, levels = camera[order], row[order], levels[order]
        # Start and step of each row on the ground
        depth = row_depths(self.rig, taps)[:, camera, row][..., None]
        right = self.rig.rotations[camera, 0, :2]
        forward = self.rig.rotations[camera, 2, :2]
        steps = depth / self.rig.focals_px[camera, None] * right
        centre = self.rig.positions[camera, :2] + depth * forward
        # Slices of equal level
        distinct, first = np.unique(levels, return_index=True)
        last = [*first[1:].tolist(), len(levels)]
        shape = (len(levels), taps, self.rig.width)
        return RowGroup(
            rows=camera * self.rig.height + row,
            origins=centre - steps * self.rig.centre_px[0],
            steps=steps,
            levels=levels,
            blocks=tuple(zip(distinct.tolist(), first.tolist(), last, strict=True)),
            coordinates=(np.empty(shape, np.float32), np.empty(shape, np.float32)),
            samples=np.empty((*shape, 4), np.uint8),
        )


def row_depths(rig: CameraRig, taps: int) -> Floats:
    """Return [T, 6, H] the ground's depth in T samples of each row; inf for the sky."""
    # A row belongs to the ground if its centre does
    row = np.arange(rig.height)
    inside = (np.arange(taps) + 0.5) / taps
    below = row + inside[:, None] - rig.centre_px[1]
    ground = (row + 0.5 > rig.centre_px[1])[None, None, :]
    nearest = CAMERA_HEIGHT_M * rig.focals_px[:, None]
    depth = nearest / np.maximum(below[:, None, :], nearest / FARTHEST_M)
    return np.where(ground, depth, np.inf)
