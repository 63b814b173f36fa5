"""Paint on the ground: every stroke goes to the colours and to the classes alike."""

from collections.abc import Iterator
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.evaluators.highway.cameras.classes import PixelClass
from me2e_compress.evaluators.highway.geometry import resample
from me2e_compress.evaluators.highway.scene import Lane, LaneMarking, Roadmap

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

ASPHALT = (98, 98, 101)
SHOULDER = (116, 112, 105)
KERB = (138, 134, 124)
WHITE = (238, 238, 238)
KERB_M = 0.3
"""A lighter rim around all pavement: where the road ends is seen without a line."""
LINE_M = 0.2
"""A little wider than the 0.15 m of real lines: our images are small."""
DASH_M, DASH_PERIOD_M = 3.0, 9.0
"""3 m painted, 6 m free, from the start of the lane: the pattern of highway-env."""
STOP_LINE_M = 0.5
BAR_M, BAR_PERIOD_M = 0.5, 1.0
"""Zebra bars."""
SUBPIXEL_BITS = 4


@dataclass(frozen=True, eq=False)
class GroundPlan:
    """The two rasters while they are painted, and where they lie in the world."""

    west_m: float
    north_m: float
    resolution_m: float
    colours: Bytes
    classes: Bytes

    def texels(self, points: Floats) -> Floats:
        """World points [..., 2] to continuous texels (column, row)."""
        offset = np.asarray(points) - (self.west_m, self.north_m)
        return np.asarray(offset * (1.0, -1.0) / self.resolution_m)

    def near(self, points: Floats) -> bool:
        """Whether a polyline may touch the rasters."""
        height, width = self.classes.shape
        low, high = (f(self.texels(points), axis=0) for f in (np.min, np.max))
        return bool((high > -width).all() and (low < (2 * width, 2 * height)).all())

    def polygon(
        self, corners: Floats, colour: tuple[int, int, int], kind: PixelClass
    ) -> None:
        """Fill a polygon [N, 2] of world points; its class goes to the same texels."""
        fixed = [self._fixed(corners)]
        cv2.fillPoly(self.colours, fixed, colour, cv2.LINE_AA, SUBPIXEL_BITS)
        cv2.fillPoly(self.classes, fixed, (int(kind),), cv2.LINE_8, SUBPIXEL_BITS)

    def line(self, points: Floats, kind: PixelClass) -> None:
        """Draw a white line of `LINE_M` along a polyline [N, 2]."""
        fixed = [self._fixed(points)]
        texels = max(1, round(LINE_M / self.resolution_m))
        cv2.polylines(
            self.colours, fixed, False, WHITE, texels, cv2.LINE_AA, SUBPIXEL_BITS
        )
        cv2.polylines(
            self.classes, fixed, False, (int(kind),), texels, cv2.LINE_8, SUBPIXEL_BITS
        )

    def _fixed(self, points: Floats) -> npt.NDArray[np.int32]:
        """Fixed-point texels for cv2, which has pixel centres at whole numbers."""
        scaled = (self.texels(points) - 0.5) * (1 << SUBPIXEL_BITS)
        return np.rint(scaled).astype(np.int32)


def offset_line(lane: Lane, lateral_m: float) -> Floats:
    """[N, 2] the lane's centre line moved to its left."""
    tangent = np.gradient(lane.centre, axis=0)
    normal = np.stack([-tangent[:, 1], tangent[:, 0]], axis=1)
    normal *= lateral_m / np.linalg.norm(normal, axis=1)[:, None]
    return np.asarray(lane.centre + normal)


def paint_lanes(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Kerbs of all lanes first, then shoulders, then asphalt: overlaps join up."""
    lanes = [lane for lane in roadmap.lanes if plan.near(lane.centre)]
    shoulders = [lane for lane in lanes if lane.shoulder]
    driven = [lane for lane in lanes if not lane.shoulder]
    layers = (
        (lanes, KERB_M, KERB, PixelClass.TERRAIN),
        (shoulders, 0.0, SHOULDER, PixelClass.SHOULDER),
        (driven, 0.0, ASPHALT, PixelClass.DRIVABLE),
    )
    for members, rim_m, colour, kind in layers:
        for lane in members:
            half = lane.width / 2 + rim_m
            sides = offset_line(lane, half), offset_line(lane, -half)[::-1]
            plan.polygon(np.concatenate(sides), colour, kind)


def paint_markings(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint the left and right edges of every lane as it asks for."""
    for lane in roadmap.lanes:
        if not plan.near(lane.centre):
            continue
        for marking, side in ((lane.left, 0.5), (lane.right, -0.5)):
            edge = offset_line(lane, side * lane.width)
            if marking is LaneMarking.SOLID:
                plan.line(edge, PixelClass.LANE_MARKING)
            elif marking is LaneMarking.DASHED:
                for dash in _dashes(edge):
                    plan.line(dash, PixelClass.LANE_MARKING)


def _dashes(edge: Floats) -> Iterator[Floats]:
    dense = resample(edge, 0.5)
    dash, period = int(DASH_M / 0.5), int(DASH_PERIOD_M / 0.5)
    for start in range(0, len(dense) - 1, period):
        yield dense[start : start + dash + 1]


def paint_stop_lines(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint bars of 0.5 m across the lanes."""
    for ends in roadmap.stop_lines:
        left, right = np.array(ends, float)
        along = right - left
        along = along / np.linalg.norm(along)
        across = np.array([-along[1], along[0]]) * STOP_LINE_M / 2
        corners = (left + across, right + across, right - across, left - across)
        plan.polygon(np.array(corners), WHITE, PixelClass.STOP_LINE)


def paint_crosswalks(plan: GroundPlan, roadmap: Roadmap) -> None:
    """Paint zebra bars along the traffic: parallel to the shorter sides."""
    for rectangle in roadmap.crosswalks:
        a, b, c, d = np.array(rectangle, float)
        if np.linalg.norm(b - a) < np.linalg.norm(c - b):
            a, b, c, d = b, c, d, a
        length = float(np.linalg.norm(b - a))
        for start in np.arange(BAR_M / 2, length - BAR_M / 2, BAR_PERIOD_M):
            near, far = start / length, min(1.0, (start + BAR_M) / length)
            bar = [a + near * (b - a), a + far * (b - a)]
            bar += [d + far * (c - d), d + near * (c - d)]
            plan.polygon(np.array(bar), WHITE, PixelClass.CROSSWALK)
