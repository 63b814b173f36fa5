"""Geometry of a route and of the roads around it, in the right-handed plane."""

from dataclasses import dataclass
from enum import IntEnum, StrEnum
from functools import cached_property

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.int64]
Point = tuple[float, float]
SPACING_M = 1.0  # distance between two points of a route, as Bench2Drive's dense routes


class Command(IntEnum):
    """Navigation commands, in the order of Bench2Drive's one-hot command."""

    LEFT = 0
    RIGHT = 1
    STRAIGHT = 2
    FOLLOW = 3
    CHANGE_LEFT = 4
    CHANGE_RIGHT = 5


class LaneMarking(StrEnum):
    """How the edge of a lane is painted."""

    NONE = "none"
    DASHED = "dashed"
    SOLID = "solid"


@dataclass(frozen=True, eq=False)
class Lane:
    """One lane of a road map."""

    # No route uses a shoulder, which is paved but not meant for driving, yet a car on
    # it is not off-road
    name: str  # unique: from>to:index
    centre: Floats  # (n, 2) in driving direction, points at most 2 m apart
    width: float
    left: LaneMarking  # of its left edge, seen in driving direction
    right: LaneMarking
    shoulder: bool = False


@dataclass(frozen=True, eq=False)
class Roadmap:
    """All lanes, stop lines and crosswalks of a world."""

    lanes: tuple[Lane, ...]
    stop_lines: tuple[tuple[Point, Point], ...] = ()
    # Four corners each, in order around the rectangle
    crosswalks: tuple[tuple[Point, Point, Point, Point], ...] = ()

    def outside_m(self, x: float, y: float) -> float:
        """Return the metres from a point to the nearest lane's edge, 0 inside one."""
        return float(self.outside_all(np.array([[x, y]]))[0])

    def outside_all(self, points: Floats) -> Floats:
        """Return [N], `outside_m` of [N, 2] points at once."""
        start, direction, length, half_width = self._chords
        # [N, C] distances of N points to C chords
        dx, dy = (points[:, i, None] - start[:, i] for i in (0, 1))
        way_x, way_y = direction.T
        along = (dx * way_x + dy * way_y).clip(0.0, length)
        away = np.hypot(dx - along * way_x, dy - along * way_y) - half_width
        return np.asarray(np.maximum(np.min(away, axis=1), 0.0))

    @cached_property
    def _chords(self) -> tuple[Floats, Floats, Floats, Floats]:
        starts = np.concatenate([lane.centre[:-1] for lane in self.lanes])
        steps = np.concatenate([np.diff(lane.centre, axis=0) for lane in self.lanes])
        lengths = np.hypot(steps[:, 0], steps[:, 1])
        chords = [len(lane.centre) - 1 for lane in self.lanes]
        half_widths = np.repeat([lane.width / 2 for lane in self.lanes], chords)
        return starts, steps / lengths[:, None], lengths, half_widths


@dataclass(frozen=True, eq=False)
class RoutePath:
    """The route's centre line, one point every metre, from start past the goal."""

    # It runs on beyond goal_m (about 60 m) so that planners can look ahead. Arrays have
    # a value, or a row, for each of n points.
    points: Floats  # (n, 2) metres
    headings: Floats  # radians, unwrapped
    lane_widths: Floats  # metres, of the lane that the route uses
    speed_limits_mps: Floats
    commands: Ints  # values of `Command`
    goal_m: float  # reaching this arc length ends the route
    left_m: Floats  # drivable metres to the left, on lanes that run the same way
    right_m: Floats  # the same to the right, shoulders included
    oncoming_m: Floats  # to the left with oncoming lanes and shoulders (>= left_m)

    @cached_property
    def _direction(self) -> Floats:
        return np.diff(self.points, axis=0)

    @property
    def length_m(self) -> float:
        """Arc length of the whole path, the part beyond the goal included."""
        return (len(self.points) - 1) * SPACING_M

    def project(
        self, x: float, y: float, near_m: float | None = None
    ) -> tuple[float, float]:
        """Return (arc length, lateral offset) of a point, positive to the left.

        ``near_m`` is the arc length where the point was last seen; only the path from
        10 m before to 30 m after it is searched then, since routes may cross
        themselves.
        """
        low, high = 0, len(self._direction)
        if near_m is not None:
            low = min(max(0, int(near_m) - 10), high - 1)
            high = min(high, int(near_m) + 30)
            high = max(high, low + 1)
        start, direction = self.points[low:high], self._direction[low:high]
        dx, dy = x - start[:, 0], y - start[:, 1]
        along = (dx * direction[:, 0] + dy * direction[:, 1]).clip(0.0, SPACING_M)
        miss_x = dx - along * direction[:, 0]
        miss_y = dy - along * direction[:, 1]
        i = int(np.argmin(miss_x * miss_x + miss_y * miss_y))
        side = direction[i, 0] * miss_y[i] - direction[i, 1] * miss_x[i]
        lateral = float(np.copysign(np.hypot(miss_x[i], miss_y[i]), side))
        return float(low + i + along[i]), lateral

    def at(
        self, s_m: npt.ArrayLike, lateral_m: npt.ArrayLike = 0.0
    ) -> tuple[Floats, Floats, Floats]:
        """Return (x, y, heading) at arc lengths and lateral offsets (broadcast)."""
        s, lateral = np.asarray(s_m, float), np.asarray(lateral_m, float)
        heading = self.value(self.headings, s)
        x = self.value(self.points[:, 0], s) - lateral * np.sin(heading)
        y = self.value(self.points[:, 1], s) + lateral * np.cos(heading)
        return x, y, heading

    def value(self, column: Floats, s_m: npt.ArrayLike) -> Floats:
        """Interpolate one of the [N] columns at arc lengths."""
        stations = np.arange(len(column)) * SPACING_M
        return np.asarray(np.interp(np.asarray(s_m, float), stations, column))

    def command_at(self, s_m: float) -> Command:
        """Return the navigation command at an arc length."""
        return Command(self.commands[int(min(max(s_m, 0), len(self.commands) - 1))])

    @cached_property
    def curvature(self) -> Floats:
        """[N] 1/m, positive to the left, smoothed over 3 m."""
        raw = np.gradient(self.headings, SPACING_M)
        return np.convolve(np.pad(raw, 1, mode="edge"), np.full(3, 1 / 3), "valid")


def polyline_headings(points: Floats) -> Floats:
    """Return [N] unwrapped headings of the chords of [N, 2]; the last repeats."""
    steps = np.diff(points, axis=0)
    headings = np.unwrap(np.arctan2(steps[:, 1], steps[:, 0]))
    return np.append(headings, headings[-1])


def resample(points: Floats, spacing_m: float) -> Floats:
    """Return points every ``spacing_m`` along a polyline, the first one kept."""
    steps = np.hypot(*np.diff(points, axis=0).T)
    arc = np.concatenate([[0.0], np.cumsum(steps)])
    stations = np.arange(0.0, arc[-1] + 1e-9, spacing_m)
    return np.stack([np.interp(stations, arc, c) for c in points.T], axis=1)


# Boxes in the plane: rows of x, y, heading, length and width, metres and radians.


def corners(boxes: Floats) -> Floats:
    """Return [..., 4, 2] corners: front left and right, rear right and left."""
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    along = signs[:, 0] * boxes[..., 3:4] / 2
    left = signs[:, 1] * boxes[..., 4:5] / 2
    cos, sin = np.cos(boxes[..., 2:3]), np.sin(boxes[..., 2:3])
    x = boxes[..., 0:1] + along * cos - left * sin
    y = boxes[..., 1:2] + along * sin + left * cos
    return np.stack([x, y], axis=-1)


def overlaps(one: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return [...] whether two boxes touch or overlap (separating axes)."""
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    return np.asarray((np.abs(apart) <= _room(one, other)).all(axis=-1))


def gaps(one: Floats, other: Floats) -> Floats:
    """Return [...] metres between the outlines of two boxes, 0 where they overlap."""
    # Between disjoint convex outlines, a corner of one is the nearest point
    nearest = np.minimum(_from_corners(one, other), _from_corners(other, one))
    return np.where(overlaps(one, other), 0.0, nearest)


def contact_times(one: Floats, other: Floats, approach: Floats) -> Floats:
    """Return [...] seconds until two boxes touch, infinite if they never do.

    Both keep their heading and velocity; ``approach`` [..., 2] is the velocity of the
    other minus that of the first, m/s. The answer is exact: the boxes touch while their
    projections on all four axes overlap.
    """
    # interval of contact on each axis
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    speed, room = _along_axes(one, other, approach), _room(one, other)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        edges = np.stack([(-room - apart) / speed, (room - apart) / speed])
    begins, ends = edges.min(axis=0), edges.max(axis=0)
    # on an axis without motion, contact is always or never
    still, inside = speed == 0.0, np.abs(apart) <= room
    begins = np.where(still, np.where(inside, -np.inf, np.inf), begins).max(axis=-1)
    ends = np.where(still, np.where(inside, np.inf, -np.inf), ends).min(axis=-1)
    touches = (begins <= ends) & (ends >= 0.0)
    return np.where(touches, np.maximum(begins, 0.0), np.inf)


def _along_axes(one: Floats, other: Floats, vectors: Floats) -> Floats:
    """Return [..., 4] vectors along and across the first box and the other."""
    columns, (x, y) = list[Floats](), np.moveaxis(vectors, -1, 0)
    for box in (one, other):
        cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
        columns += [x * cos + y * sin, y * cos - x * sin]
    return np.stack(columns, axis=-1)


def _room(one: Floats, other: Floats) -> Floats:
    """Return [..., 4] centre distances at contact, on each axis."""
    turn = other[..., 2] - one[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    columns = list[Floats]()
    for box, second in ((one, other), (other, one)):
        length, width = second[..., 3], second[..., 4]
        columns.append((box[..., 3] + length * cos + width * sin) / 2)
        columns.append((box[..., 4] + length * sin + width * cos) / 2)
    return np.stack(columns, axis=-1)


def _from_corners(one: Floats, other: Floats) -> Floats:
    """Return [...] the smallest distance of the first's corners to the other box."""
    away = corners(one) - other[..., None, :2]
    cos, sin = np.cos(other[..., 2:3]), np.sin(other[..., 2:3])
    along = np.abs(away[..., 0] * cos + away[..., 1] * sin) - other[..., 3:4] / 2
    across = np.abs(away[..., 1] * cos - away[..., 0] * sin) - other[..., 4:5] / 2
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return np.asarray(outside.min(axis=-1))
