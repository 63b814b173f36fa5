"""Builds highway-env lanes from right-handed poses, and reads them back.

highway-env's plane has y pointing down, so that a heading grows clockwise and a
lane's positive side is its right. The sign flips live here and in `flip`, nowhere
else.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from highway_env.road.lane import AbstractLane, CircularLane, LineType, StraightLane
from highway_env.road.road import RoadNetwork

from me2e_compress.simulator.plane_geometry import (
    SPACING_M,
    Command,
    Floats,
    Lane,
    LaneMarking,
    Point,
    Roadmap,
    RoutePath,
    polyline_headings,
    resample,
)

LaneIndex = tuple[str, str, int]
LANE_WIDTH_M = 3.5  # of urban lanes in CARLA's towns and most of nuScenes
CHORD_M = 1.0  # spacing of the points of a lane's centre line
_LINE = {
    LaneMarking.NONE: LineType.NONE,
    LaneMarking.DASHED: LineType.STRIPED,
    LaneMarking.SOLID: LineType.CONTINUOUS_LINE,
}
_MARKING = {line: marking for marking, line in _LINE.items()}
ANNOUNCED_M = 20.0  # how long before a junction or a lane change the command says so
FINE_M = 0.1
WIDEST_M = 9.0  # how far to the side we look for road
PROBE_M = 0.25
TOUCHING_M = 0.01  # lanes side by side leave no hole, whatever the last digit says
_CHANGES = (Command.CHANGE_LEFT, Command.CHANGE_RIGHT)


def flip(x: float, y: float) -> Floats:
    """Convert a point between the two planes (the map is its own inverse)."""
    return np.array([x, -y])


@dataclass(frozen=True, slots=True)
class Pose:
    """A place and a direction in the right-handed plane."""

    x: float
    y: float
    heading: float

    def moved(self, forward_m: float, left_m: float = 0.0) -> "Pose":
        """Return the pose after a step in its own frame."""
        c, s = math.cos(self.heading), math.sin(self.heading)
        return Pose(
            self.x + c * forward_m - s * left_m,
            self.y + s * forward_m + c * left_m,
            self.heading,
        )

    def turned(self, angle_rad: float) -> "Pose":
        """Return the pose turned on the spot, positive to the left."""
        return Pose(self.x, self.y, self.heading + angle_rad)

    def along_arc(self, radius_m: float, angle_rad: float) -> "Pose":
        """Return the pose after an arc; a positive angle turns left."""
        side = math.copysign(radius_m, angle_rad)
        return self.moved(0.0, side).turned(angle_rad).moved(0.0, -side)


@dataclass(frozen=True, slots=True)
class Section:
    """Cross-section of one carriageway: parallel lanes, the leftmost first."""

    lanes: int = 1
    width: float = LANE_WIDTH_M
    limit_mps: float = 50 / 3.6
    left: LaneMarking = LaneMarking.SOLID
    between: LaneMarking = LaneMarking.DASHED
    right: LaneMarking = LaneMarking.SOLID
    shoulder: bool = False


PLAIN = Section(left=LaneMarking.NONE, right=LaneMarking.NONE)  # in junctions


class Network:
    """A highway-env road network under construction, in right-handed poses."""

    def __init__(self) -> None:
        self.graph = RoadNetwork()
        self.shoulders: list[LaneIndex] = []
        self.ranks: dict[LaneIndex, int] = {}  # in junctions; low ones go first
        self.closed: list[LaneIndex] = []  # ending or beginning within a road
        self._sampled: dict[LaneIndex, tuple[Floats, Floats]] = {}

    def straight(
        self, start: str, end: str, pose: Pose, length_m: float, section: Section
    ) -> Pose:
        """Add a straight from ``pose`` on; return where its leftmost lane ends."""
        for i in range(section.lanes):
            first = pose.moved(0.0, -i * section.width)
            last = first.moved(length_m)
            lane = StraightLane(flip(first.x, first.y), flip(last.x, last.y))
            self._add(start, end, lane, section, i)
        return pose.moved(length_m)

    def arc(
        self,
        start: str,
        end: str,
        pose: Pose,
        radius_m: float,
        angle_rad: float,
        section: Section,
    ) -> Pose:
        """Add an arc (positive angle: left); return where its leftmost lane ends."""
        # lanes around one centre; the leftmost, first, has the radius
        left_turn = angle_rad > 0
        side = radius_m if left_turn else -radius_m
        centre = pose.moved(0.0, side)
        begin = pose.heading - math.copysign(math.pi / 2, angle_rad)
        for i in range(section.lanes):
            outwards = i * section.width
            # in highway-env's plane, whose y points down
            lane = CircularLane(
                flip(centre.x, centre.y),
                radius_m + outwards if left_turn else radius_m - outwards,
                -begin,
                -(begin + angle_rad),
                clockwise=not left_turn,
            )
            self._add(start, end, lane, section, i)
        return pose.along_arc(radius_m, angle_rad)

    def lane(self, index: LaneIndex) -> AbstractLane:
        """Return the highway-env lane."""
        return self.graph.get_lane(index)

    def pose(self, index: LaneIndex, s_m: float, left_m: float = 0.0) -> Pose:
        """Return the pose of a lane at an arc length and an offset to the left."""
        lane = self.lane(index)
        x, y = lane.position(s_m, -left_m)
        return Pose(float(x), -float(y), -float(lane.heading_at(s_m)))

    def length(self, index: LaneIndex) -> float:
        """Return the length of a lane in metres."""
        return float(self.lane(index).length)

    def rest(
        self, chain: Sequence[LaneIndex], s_m: float
    ) -> tuple[list[LaneIndex], float]:
        """Return a chain from an arc length on, and that in its first lane."""
        lanes = list(chain)
        while len(lanes) > 1 and s_m > self.length(lanes[0]):
            s_m -= self.length(lanes.pop(0))
        return lanes, s_m

    def centre(self, index: LaneIndex) -> Floats:
        """Return the [N, 2] centre line, at most `CHORD_M` apart, cached."""
        return self.samples(index)[1]

    def samples(self, index: LaneIndex) -> tuple[Floats, Floats]:
        """Return the [N] arc lengths of the centre line's points, and these."""
        if index not in self._sampled:
            length = self.length(index)
            count = max(2, math.ceil(length / CHORD_M) + 1)
            stations = np.linspace(0.0, length, count)
            poses = [self.pose(index, float(s)) for s in stations]
            line = np.array([(pose.x, pose.y) for pose in poses])
            self._sampled[index] = stations, line
        return self._sampled[index]

    def roadmap(
        self,
        stop_lines: tuple[tuple[Point, Point], ...],
        crosswalks: tuple[tuple[Point, Point, Point, Point], ...],
    ) -> Roadmap:
        """Return everything painted, in the right-handed plane."""
        lanes = list[Lane]()
        for index, lane in self.graph.lanes_dict().items():
            left, right = (_MARKING[line] for line in lane.line_types)
            name = f"{index[0]}>{index[1]}:{index[2]}"
            centre, shoulder = self.centre(index), index in self.shoulders
            lanes.append(Lane(name, centre, float(lane.width), left, right, shoulder))
        return Roadmap(tuple(lanes), stop_lines, crosswalks)

    def _add(
        self, start: str, end: str, lane: AbstractLane, section: Section, number: int
    ) -> None:
        left = section.left if number == 0 else section.between
        right = section.right if number == section.lanes - 1 else section.between
        lane.width, lane.speed_limit = section.width, section.limit_mps
        lane.line_types = [_LINE[left], _LINE[right]]
        self.graph.add_lane(start, end, lane)
        if section.shoulder:
            self.shoulders.append((start, end, len(self.graph.graph[start][end]) - 1))


class LaneTable:
    """All lanes of a network as arrays (highway-env's y-down plane)."""

    # highway-env asks every lane about every vehicle one by one, which takes most of
    # its time; straight and circular lanes, the only ones we build, allow one
    # vectorised answer

    def __init__(self, network: RoadNetwork) -> None:
        lanes = network.lanes_dict()
        self.column: dict[LaneIndex, int] = {key: i for i, key in enumerate(lanes)}
        self.length: Floats = np.array([lane.length for lane in lanes.values()])
        # Straight and circular lanes apart, each as arrays
        lines = [lane for lane in lanes.values() if isinstance(lane, StraightLane)]
        self._start = np.array([lane.start for lane in lines]).reshape(-1, 2)
        self._along = np.array([lane.direction for lane in lines]).reshape(-1, 2)
        arcs = [lane for lane in lanes.values() if isinstance(lane, CircularLane)]
        is_line = np.array([isinstance(e, StraightLane) for e in lanes.values()], bool)
        self._straight, self._circular = is_line, ~is_line  # (lanes,) masks
        self._centre = np.array([lane.center for lane in arcs]).reshape(-1, 2)
        self._radius = np.array([lane.radius for lane in arcs])
        self._phase = np.array([lane.start_phase for lane in arcs])
        self._sense = np.array([lane.direction for lane in arcs])

    def coordinates(self, points: Floats) -> tuple[Floats, Floats]:
        """Return arc lengths and lateral offsets (highway-env's sign) in all lanes.

        ``points`` is [N, 2] in highway-env's plane; both results are [N, lanes].
        """
        s = np.empty((len(points), len(self.length)))
        r = np.empty_like(s)
        dx, dy = (points[:, i, None] - self._start[:, i] for i in (0, 1))
        ax, ay = self._along.T
        s[:, self._straight] = dx * ax + dy * ay
        r[:, self._straight] = dy * ax - dx * ay
        dx, dy = (points[:, i, None] - self._centre[:, i] for i in (0, 1))
        turn = np.arctan2(dy, dx) - self._phase
        turn = (turn + np.pi) % (2 * np.pi) - np.pi
        s[:, self._circular] = self._sense * turn * self._radius
        r[:, self._circular] = self._sense * (self._radius - np.hypot(dx, dy))
        return s, r

    def headings(self, s: Floats) -> Floats:
        """Return headings [N, lanes] (highway-env's sign) at arc lengths [N, lanes]."""
        angles = np.empty_like(s)
        angles[:, self._straight] = np.arctan2(self._along[:, 1], self._along[:, 0])
        turned = s[:, self._circular] / self._radius + np.pi / 2
        angles[:, self._circular] = self._phase + self._sense * turned
        return angles


# The centre line of a route, from the lanes that it uses.


@dataclass(frozen=True, slots=True)
class Leg:
    """A piece of the route on one lane."""

    # A hole between the end of a leg and the beginning of the next is filled by a
    # smooth curve: that is how a route changes lanes
    lane: LaneIndex
    command: Command = Command.FOLLOW
    enter_m: float = 0.0
    leave_m: float | None = None


def build_path(network: Network, legs: Sequence[Leg], goal_m: float) -> RoutePath:
    """Join legs into a path of points 1 m apart."""
    pieces, marks = list[Floats](), list[tuple[float, float, Command]]()
    owners = list[tuple[float, int]]()
    done = 0.0
    # one dense piece a leg, a bridge where it starts elsewhere, its command's stretch
    for number, leg in enumerate(legs):
        end = network.length(leg.lane) if leg.leave_m is None else leg.leave_m
        count = max(2, round((end - leg.enter_m) / FINE_M) + 1)
        stations = np.linspace(leg.enter_m, end, count)
        poses = [network.pose(leg.lane, float(s)) for s in stations]
        piece = np.array([(p.x, p.y) for p in poses])
        begin = change_end = done
        bridged = pieces and np.hypot(*(piece[0] - pieces[-1][-1])) > 0.5
        for line in (_bridge(pieces[-1], piece), piece) if bridged else (piece,):
            change_end = done
            pieces.append(line)
            done += float(np.hypot(*np.diff(line, axis=0).T).sum())
            owners.append((done, number))
        stop = change_end if leg.command in _CHANGES else done
        marks.append((begin - ANNOUNCED_M, stop, leg.command))
    # points 1 m apart, each with what its lane and the road beside it allow
    dense = np.concatenate(pieces)
    steps = np.hypot(*np.diff(dense, axis=0).T)
    points = resample(dense[np.concatenate([[True], steps > 1e-6])], SPACING_M)
    arc = np.arange(len(points)) * SPACING_M
    at = np.searchsorted([end for end, _ in owners], arc)
    owner = [owners[min(i, len(owners) - 1)][1] for i in at.tolist()]
    width = np.array([network.lane(legs[i].lane).width for i in owner], float)
    limit = np.array([network.lane(legs[i].lane).speed_limit for i in owner], float)
    headings = polyline_headings(points)
    # commands, announced before their stretch
    commands = np.full(len(points), int(Command.FOLLOW), dtype=np.int64)
    for begin, end, command in marks:
        if command is not Command.FOLLOW:
            commands[(arc >= begin) & (arc < end)] = int(command)
    beside = _room_beside(network, points, headings)
    return RoutePath(points, headings, width, limit, commands, goal_m, *beside)


def _bridge(before: Floats, after: Floats) -> Floats:
    """Return a cubic Hermite curve from the end of a piece to the next one's start."""
    start, end = before[-1], after[0]
    reach = float(np.hypot(*(end - start)))
    out = (before[-1] - before[-2]) / np.hypot(*(before[-1] - before[-2])) * reach
    into = (after[1] - after[0]) / np.hypot(*(after[1] - after[0])) * reach
    t = np.linspace(0.0, 1.0, max(2, round(reach / FINE_M) + 1))[:, None]
    points = (
        (2 * t**3 - 3 * t**2 + 1) * start
        + (t**3 - 2 * t**2 + t) * out
        + (3 * t**2 - 2 * t**3) * end
        + (t**3 - t**2) * into
    )
    return np.asarray(points)


def _room_beside(
    network: Network, points: Floats, headings: Floats
) -> tuple[Floats, Floats, Floats]:
    """Return metres of road left (same way), right (with shoulders), left (all)."""
    table = LaneTable(network.graph)
    shoulder = np.zeros(len(table.length), bool)
    for index in network.shoulders:
        shoulder[table.column[index]] = True
    widths = np.array([network.lane(index).width for index in table.column])
    # probe points to either side of the route, every quarter of a metre
    reach = np.arange(PROBE_M, WIDEST_M, PROBE_M)
    sides = list[Floats]()
    cases = ((1, True, False), (-1, True, True), (1, False, True))
    for sign, same_way, with_shoulder in cases:
        normal = np.stack([-np.sin(headings), np.cos(headings)], axis=1) * sign
        probes = points[:, None, :] + reach[None, :, None] * normal[:, None, :]
        flat = probes.reshape(-1, 2) @ np.diag(flip(1.0, 1.0))
        s, r = table.coordinates(flat)
        inside = (s > -0.5) & (s < table.length + 0.5)
        inside &= np.abs(r) <= widths / 2 + TOUCHING_M
        # oncoming lanes and shoulders count on some sides only
        if same_way:
            mine = -np.repeat(headings, len(reach))[:, None]
            way = np.cos(table.headings(s) - mine) > 0.5
            inside &= way | shoulder
        if not with_shoulder:
            inside &= ~shoulder
        # the free width ends at the first probe off the road
        road = inside.any(axis=1).reshape(len(points), len(reach))
        free = np.where(road.all(axis=1), len(reach), np.argmin(road, axis=1))
        sides.append(free * PROBE_M)
    return sides[0], sides[1], sides[2]
