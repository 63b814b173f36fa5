"""A road of straights and arcs with lanes in both directions, used by most layouts."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

from me2e_compress.simulator.plane_geometry import LaneMarking
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Network,
    Pose,
    Section,
)


@dataclass(frozen=True, slots=True)
class Straight:
    """A straight piece."""

    length_m: float


@dataclass(frozen=True, slots=True)
class Arc:
    """A bend; positive angles turn left. The radius is the leftmost lane's."""

    radius_m: float
    angle_rad: float


Piece = Straight | Arc


@dataclass(frozen=True)
class Carriageway:
    """A finished road.

    Attributes:
        network: The network it belongs to.
        forward: Edges in driving direction.
        backward: Edges of the oncoming lanes, in their driving direction.
        verge: Edges of the shoulder on the right, in driving direction.
        lanes: Number of forward lanes.
        end: Pose at the end of the leftmost forward lane.
    """

    network: Network
    forward: tuple[tuple[str, str], ...]
    backward: tuple[tuple[str, str], ...]
    verge: tuple[tuple[str, str], ...]
    lanes: int
    end: Pose

    def ahead(self, lane: int) -> list[LaneIndex]:
        """Return the chain of a forward lane; 0 is the leftmost."""
        return [(a, b, lane) for a, b in self.forward]

    def oncoming(self, lane: int = 0) -> list[LaneIndex]:
        """Return the chain of an oncoming lane; 0 is next to the forward lanes."""
        return [(a, b, lane) for a, b in self.backward]

    def shoulder(self) -> list[LaneIndex]:
        """Return the chain of the shoulder or parking lane."""
        return [(a, b, 0) for a, b in self.verge]

    @property
    def length_m(self) -> float:
        """Length of the leftmost forward lane."""
        return sum(self.network.length(index) for index in self.ahead(0))

    def pose(self, s_m: float, lane: int = 0, left_m: float = 0.0) -> Pose:
        """Return the pose at an arc length along a forward lane."""
        for index in self.ahead(lane):
            length = self.network.length(index)
            if s_m <= length or index == self.ahead(lane)[-1]:
                return self.network.pose(index, s_m, left_m)
            s_m -= length
        return self.end


def carriageway(
    network: Network,
    name: str,
    start: Pose,
    pieces: Sequence[Piece],
    section: Section,
    oncoming: int = 0,
    shoulder_m: float = 0.0,
) -> Carriageway:
    """Build a road.

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
    end = start
    for piece in pieces:
        end = _after(end, piece)
    return Carriageway(
        network,
        tuple(edges[f"{name}f"]),
        tuple(reversed(edges.get(f"{name}o", []))),
        tuple(edges.get(f"{name}v", [])),
        section.lanes,
        end,
    )


@dataclass(frozen=True, slots=True)
class _Row:
    """Parallel lanes of one direction, ``left_m`` beside the reference line."""

    prefix: str
    section: Section
    left_m: float
    forward: bool


def _rows(
    name: str, section: Section, oncoming: int, shoulder_m: float
) -> Iterator[_Row]:
    width, centre = section.width, LaneMarking.DASHED
    verge = replace(
        section,
        lanes=1,
        width=shoulder_m,
        left=LaneMarking.NONE,
        right=LaneMarking.NONE,
        shoulder=True,
    )
    # forward lanes, oncoming lanes, then the shoulders outside them
    ahead = replace(section, left=centre) if oncoming else section
    yield _Row(f"{name}f", ahead, 0.0, True)
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
) -> list[tuple[str, str]]:
    """Lay one row of lanes along the pieces."""
    edges, pose, left = list[tuple[str, str]](), start, row.left_m
    for k, piece in enumerate(pieces):
        after = _after(pose, piece)
        here, there = f"{row.prefix}{k}", f"{row.prefix}{k + 1}"
        # oncoming lanes begin at the far end of the piece
        if row.forward:
            a, b, begin = here, there, pose.moved(0.0, left)
        else:
            a, b, begin = there, here, after.moved(0.0, left).turned(math.pi)
        # arcs keep their centre: the radius changes with the offset
        if isinstance(piece, Straight):
            network.straight(a, b, begin, piece.length_m, row.section)
        else:
            inwards = left if piece.angle_rad > 0 else -left
            angle = piece.angle_rad if row.forward else -piece.angle_rad
            network.arc(a, b, begin, piece.radius_m - inwards, angle, row.section)
        edges.append((a, b))
        pose = after
    return edges


def _after(pose: Pose, piece: Piece) -> Pose:
    if isinstance(piece, Straight):
        return pose.moved(piece.length_m)
    return pose.along_arc(piece.radius_m, piece.angle_rad)


def straight_section(lanes: int, limit_mps: float) -> Section:
    """Return the usual cross-section."""
    return Section(lanes=lanes, width=LANE_WIDTH_M, limit_mps=limit_mps)
