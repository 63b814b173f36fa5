"""Roads of straights and arcs: parallel lanes, oncoming ones, and shoulders."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from typing import NamedTuple

from me2e_compress.simulator.plane_geometry import LaneMarking
from me2e_compress.simulator.traffic.network import LaneIndex, Network, Pose, Section

BEFORE_M = 60.0
"""Road behind the ego's start, from where others catch up."""
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
