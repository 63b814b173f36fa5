"""Roads without junctions: several lanes one way, one lane each way, with parking."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from me2e_compress.simulator.plane_geometry import Command, LaneMarking
from me2e_compress.simulator.traffic.legs import Leg
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Network,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.stage import GOAL_M, Stage

BEFORE_M = 60.0
"""Road behind the ego's start, from where others catch up."""
BEYOND_M = 120.0
"""Road beyond the goal."""
TOTAL_M = BEFORE_M + GOAL_M + BEYOND_M
PARKING_M = 2.5
"""Width of a parking lane."""

Edge = tuple[str, str]


class Piece(NamedTuple):
    """A straight of a length; or an arc of a radius, where positive angles turn left.

    The radius is the leftmost lane's.
    """

    size_m: float
    angle_rad: float = 0.0

    def end(self, pose: Pose) -> Pose:
        """Return the pose at which it ends."""
        if self.angle_rad:
            return pose.along_arc(self.size_m, self.angle_rad)
        return pose.moved(self.size_m)


STRAIGHT = (Piece(TOTAL_M),)


@dataclass(frozen=True)
class Street:
    """A road; the ego's route begins `BEFORE_M` after the road does.

    Attributes:
        forward: Edges in driving direction.
        backward: Edges of the oncoming lanes, in their driving direction.
        verge: Edges of the shoulder on the right, in driving direction.
        lane: The lane that the ego follows or enters; 0 is the leftmost.
    """

    forward: Sequence[Edge]
    backward: Sequence[Edge] = ()
    verge: Sequence[Edge] = ()
    lane: int = 0

    def ahead(self, lane: int | None = None) -> list[LaneIndex]:
        """Return the chain of a forward lane, by default of the ego's."""
        return [(a, b, self.lane if lane is None else lane) for a, b in self.forward]

    def oncoming(self) -> list[LaneIndex]:
        """Return the chain of the oncoming lane."""
        return [(a, b, 0) for a, b in self.backward]

    def shoulder(self) -> list[LaneIndex]:
        """Return the chain of the shoulder or parking lane."""
        return [(a, b, 0) for a, b in self.verge]

    def other_lane(self) -> int:
        """Return a lane beside the ego's."""
        return self.lane - 1 if self.lane > 0 else self.lane + 1


def origin(stage: Stage) -> Pose:
    """Return the pose at which the world begins, with a random heading."""
    return Pose(0.0, 0.0, stage.uniform("heading_rad", -math.pi, math.pi))


def start_speed(stage: Stage) -> float:
    """Return the ego's speed at frame 0 (m/s)."""
    return stage.uniform("speed_mps", 7.0, 10.0)


def multilane(stage: Stage) -> Street:
    """Lay a straight one-way road of two or three lanes and a narrow shoulder."""
    lanes, lane = _lanes(stage)
    return _street(stage, Section(lanes, limit_mps=14.0), 1.0, lane=lane)


def single_lane(stage: Stage) -> Street:
    """Lay a straight one-way road of one lane, without room to overtake."""
    return _street(stage, Section(limit_mps=14.0), 0.5)


def bend(stage: Stage) -> Street:
    """Lay a one-way road of two or three lanes through a bend."""
    lanes, lane = _lanes(stage)
    pieces = _curve(stage, 60.0, 100.0)
    return _street(stage, Section(lanes, limit_mps=14.0), 1.0, pieces, lane=lane)


def two_way(stage: Stage) -> Street:
    """Lay a straight road, one lane each way; overtaking uses the oncoming lane."""
    return _street(stage, Section(limit_mps=13.0), 0.6, oncoming=1)


def two_way_bend(stage: Stage) -> Street:
    """Lay a winding road with one lane each way and a paved shoulder."""
    pieces = _curve(stage, 50.0, 90.0)
    return _street(stage, Section(limit_mps=12.0), 1.8, pieces, oncoming=1)


def parking_street(stage: Stage) -> Street:
    """Lay a street with one lane each way and a parking lane on either side."""
    return _street(stage, Section(limit_mps=12.0), PARKING_M, oncoming=1)


def parking_bay(stage: Stage) -> Street:
    """Lay the parking street; the ego starts, at rest, in the parking lane."""
    section = Section(limit_mps=12.0)
    street = lay_road(
        stage.network, "r", origin(stage), STRAIGHT, section, 1, PARKING_M
    )
    stay = stage.uniform("stay_m", 8.0, 12.0)
    (bay,), (lane,) = street.shoulder(), street.ahead()
    legs = [
        Leg(bay, enter_m=BEFORE_M, leave_m=BEFORE_M + stay),
        Leg(lane, Command.CHANGE_LEFT, enter_m=BEFORE_M + stay + 14.0),
    ]
    stage.drive(legs, 2.0)
    return street


def zebra_street(stage: Stage) -> Street:
    """Lay a two-way street with a marked crosswalk; see `Stage.crosswalks`."""
    street = two_way(stage)
    s = stage.uniform("crosswalk_m", 55.0, 80.0)
    left, right = 1.5 * LANE_WIDTH_M, -0.5 * LANE_WIDTH_M
    places = ((-2.0, left), (2.0, left), (2.0, right), (-2.0, right))
    stage.add_crosswalk([stage.route_pose(s + along, at) for along, at in places])
    return street


def _lanes(stage: Stage) -> tuple[int, int]:
    """Return two or three lanes, and the one in which the ego drives."""
    lanes = stage.integer("lanes", 2, 3)
    return lanes, min(stage.integer("ego_lane", 0, lanes - 1), lanes - 1)


def _curve(stage: Stage, tightest: float, widest: float) -> tuple[Piece, ...]:
    radius = stage.uniform("radius_m", tightest, widest)
    side = 1.0 if stage.choice("bend", ("left", "right")) == "left" else -1.0
    after = GOAL_M - 90.0 + BEYOND_M
    return Piece(BEFORE_M + 30.0), Piece(radius, side * (60.0 / radius)), Piece(after)


def _street(
    stage: Stage,
    section: Section,
    shoulder_m: float,
    pieces: Sequence[Piece] = STRAIGHT,
    lane: int = 0,
    oncoming: int = 0,
) -> Street:
    """Lay a road whose lane the ego follows to the goal."""
    start = origin(stage)
    road = lay_road(stage.network, "r", start, pieces, section, oncoming, shoulder_m)
    first, *others = road.ahead(lane)
    legs = [Leg(first, enter_m=BEFORE_M), *(Leg(index) for index in others)]
    stage.drive(legs, start_speed(stage))
    return replace(road, lane=lane)


def lay_road(
    network: Network,
    name: str,
    start: Pose,
    pieces: Sequence[Piece],
    section: Section,
    oncoming: int = 0,
    shoulder_m: float = 0.0,
) -> Street:
    """Build a road of straights and arcs.

    Args:
        network: Where to build.
        name: Prefix of its node names.
        start: Pose at the beginning of its leftmost forward lane.
        pieces: Straights and arcs, joined end to end.
        section: Forward lanes; oncoming lanes get the same width and limit.
        oncoming: Number of oncoming lanes, left of the forward ones.
        shoulder_m: Width of a paved shoulder on the right, 0 for none. A two-way road
            gets one on its other side too.
    """
    edges = {
        row.prefix: _lay(network, row, start, pieces)
        for row in _rows(name, section, oncoming, shoulder_m)
    }
    backward = edges.get(f"{name}o", [])[::-1]
    return Street(edges[f"{name}f"], backward, edges.get(f"{name}v", []))


class _Row(NamedTuple):
    """Parallel lanes of one direction, ``left_m`` beside the reference line."""

    prefix: str
    section: Section
    left_m: float
    forward: bool


def _rows(
    name: str, section: Section, oncoming: int, shoulder_m: float
) -> Iterator[_Row]:
    width, none = section.width, LaneMarking.NONE
    verge = replace(
        section, lanes=1, width=shoulder_m, left=none, right=none, shoulder=True
    )
    # forward lanes, oncoming lanes, then the shoulders outside them
    centre = LaneMarking.DASHED if oncoming else section.left
    yield _Row(f"{name}f", replace(section, left=centre), 0.0, True)
    if oncoming:
        opposite = replace(section, lanes=oncoming, left=centre)
        yield _Row(f"{name}o", opposite, width, False)
    if shoulder_m:
        beside = (section.lanes - 0.5) * width + shoulder_m / 2
        yield _Row(f"{name}v", verge, -beside, True)
    if shoulder_m and oncoming:
        beyond = (oncoming + 0.5) * width + shoulder_m / 2
        yield _Row(f"{name}w", verge, beyond, False)


def _lay(
    network: Network, row: _Row, start: Pose, pieces: Sequence[Piece]
) -> list[Edge]:
    """Lay one row of lanes along the pieces."""
    edges, pose, left = list[Edge](), start, row.left_m
    for k, piece in enumerate(pieces):
        after = piece.end(pose)
        here, there = f"{row.prefix}{k}", f"{row.prefix}{k + 1}"
        # oncoming lanes begin at the far end of the piece
        if row.forward:
            a, b, begin = here, there, pose.moved(0.0, left)
        else:
            a, b, begin = there, here, after.moved(0.0, left).turned(math.pi)
        # arcs keep their centre: the radius changes with the offset
        if piece.angle_rad:
            radius = piece.size_m - (left if piece.angle_rad > 0 else -left)
            angle = piece.angle_rad if row.forward else -piece.angle_rad
            network.arc(a, b, begin, radius, angle, row.section)
        else:
            network.straight(a, b, begin, piece.size_m, row.section)
        edges.append((a, b))
        pose = after
    return edges
