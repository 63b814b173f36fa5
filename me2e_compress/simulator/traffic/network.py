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
    Floats,
    Lane,
    LaneMarking,
    Point,
    Roadmap,
)

LaneIndex = tuple[str, str, int]
LANE_WIDTH_M = 3.5
"""Width of an urban lane in CARLA's towns and of most lanes in nuScenes."""
CHORD_M = 1.0
"""Spacing of the points of a lane's centre line."""
_LINE = {
    LaneMarking.NONE: LineType.NONE,
    LaneMarking.DASHED: LineType.STRIPED,
    LaneMarking.SOLID: LineType.CONTINUOUS_LINE,
}
_MARKING = {line: marking for marking, line in _LINE.items()}


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

    def markings(self, lane: int) -> tuple[LaneMarking, LaneMarking]:
        """Return the left and right marking of one lane."""
        left = self.left if lane == 0 else self.between
        right = self.right if lane == self.lanes - 1 else self.between
        return left, right


PLAIN = Section(left=LaneMarking.NONE, right=LaneMarking.NONE)
"""An unpainted lane, as inside a junction."""


class Network:
    """A highway-env road network under construction, in right-handed poses."""

    def __init__(self) -> None:
        self.graph = RoadNetwork()
        self.shoulders: list[LaneIndex] = []
        self.ranks: dict[LaneIndex, int] = {}
        """Lanes inside junctions; those of a lower rank have priority."""
        self.closed: list[LaneIndex] = []
        """Lanes that end, or begin, in the middle of a road."""
        self._sampled: dict[LaneIndex, tuple[Floats, Floats]] = {}

    def straight(
        self, start: str, end: str, pose: Pose, length_m: float, section: Section
    ) -> Pose:
        """Add a straight piece and return the pose where its leftmost lane ends.

        ``pose`` is where the leftmost lane begins.
        """
        for i in range(section.lanes):
            first = pose.moved(0.0, -i * section.width)
            last = first.moved(length_m)
            left, right = section.markings(i)
            lane = StraightLane(
                flip(first.x, first.y),
                flip(last.x, last.y),
                width=section.width,
                line_types=(_LINE[left], _LINE[right]),
                speed_limit=section.limit_mps,
            )
            self._add(start, end, lane, section)
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
        """Add an arc and return the pose where the leftmost lane ends.

        The radius is the leftmost lane's; positive angles turn left.
        """
        # lanes around one centre, the leftmost first
        left_turn = angle_rad > 0
        side = radius_m if left_turn else -radius_m
        centre = pose.moved(0.0, side)
        begin = pose.heading - math.copysign(math.pi / 2, angle_rad)
        for i in range(section.lanes):
            outwards = i * section.width
            left, right = section.markings(i)
            # in highway-env's plane, whose y points down
            lane = CircularLane(
                flip(centre.x, centre.y),
                radius_m + outwards if left_turn else radius_m - outwards,
                -begin,
                -(begin + angle_rad),
                clockwise=not left_turn,
                width=section.width,
                line_types=[_LINE[left], _LINE[right]],
                speed_limit=section.limit_mps,
            )
            self._add(start, end, lane, section)
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
            centre, limit = self.centre(index), float(lane.speed_limit)
            shoulder = index in self.shoulders
            width = float(lane.width)
            lanes.append(Lane(name, centre, width, left, right, limit, shoulder))
        return Roadmap(tuple(lanes), stop_lines, crosswalks)

    def _add(self, start: str, end: str, lane: AbstractLane, section: Section) -> None:
        self.graph.add_lane(start, end, lane)
        if section.shoulder:
            self.shoulders.append((start, end, len(self.graph.graph[start][end]) - 1))
