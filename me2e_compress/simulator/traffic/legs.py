"""The centre line of a route, from the lanes that it uses.

Coordinates of many points in all lanes at once.

highway-env asks every lane about every vehicle one by one, which takes most of its
time; straight and circular lanes, the only ones we build, allow one vectorised
answer.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from highway_env.road.lane import CircularLane, StraightLane
from highway_env.road.road import RoadNetwork

from me2e_compress.simulator.plane_geometry import (
    SPACING_M,
    Command,
    Floats,
    RoutePath,
    polyline_headings,
    resample,
)
from me2e_compress.simulator.traffic.network import LaneIndex, Network, flip


class LaneTable:
    """All lanes of a network as arrays (highway-env's y-down plane)."""

    def __init__(self, network: RoadNetwork) -> None:
        lanes = network.lanes_dict()
        self.column: dict[LaneIndex, int] = {key: i for i, key in enumerate(lanes)}
        self.length: Floats = np.array([lane.length for lane in lanes.values()])
        # straight and circular lanes apart, each as arrays
        straight, circular = list[int](), list[int]()
        for i, lane in enumerate(lanes.values()):
            (straight if isinstance(lane, StraightLane) else circular).append(i)
        self._straight: npt.NDArray[np.int64] = np.array(straight, dtype=np.int64)
        self._circular: npt.NDArray[np.int64] = np.array(circular, dtype=np.int64)
        values = list(lanes.values())
        lines = [lane for lane in values if isinstance(lane, StraightLane)]
        self._start = np.array([lane.start for lane in lines]).reshape(-1, 2)
        self._along = np.array([lane.direction for lane in lines]).reshape(-1, 2)
        arcs = [lane for lane in values if isinstance(lane, CircularLane)]
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
        if len(self._straight):
            dx, dy = (points[:, i, None] - self._start[:, i] for i in (0, 1))
            ax, ay = self._along[:, 0], self._along[:, 1]
            s[:, self._straight] = dx * ax + dy * ay
            r[:, self._straight] = dy * ax - dx * ay
        if len(self._circular):
            dx, dy = (points[:, i, None] - self._centre[:, i] for i in (0, 1))
            turn = np.arctan2(dy, dx) - self._phase
            turn = (turn + np.pi) % (2 * np.pi) - np.pi
            s[:, self._circular] = self._sense * turn * self._radius
            away = np.hypot(dx, dy)
            r[:, self._circular] = self._sense * (self._radius - away)
        return s, r

    def headings(self, s: Floats) -> Floats:
        """Return headings [N, lanes] (highway-env's sign) at arc lengths [N, lanes]."""
        angles = np.empty_like(s)
        along = np.arctan2(self._along[:, 1], self._along[:, 0])
        angles[:, self._straight] = along
        if len(self._circular):
            turned = s[:, self._circular] / self._radius + np.pi / 2
            angles[:, self._circular] = self._phase + self._sense * turned
        return angles


ANNOUNCED_M = 20.0
"""How long before a junction or a lane change the command says so."""
FINE_M = 0.1
WIDEST_M = 9.0
"""How far to the side we look for road."""
PROBE_M = 0.25
TOUCHING_M = 0.01
"""Lanes side by side leave no hole, whatever the last digit says."""
_CHANGES = (Command.CHANGE_LEFT, Command.CHANGE_RIGHT)


@dataclass(frozen=True, slots=True)
class Leg:
    """A piece of the route on one lane.

    A hole between the end of a leg and the beginning of the next is filled by a smooth
    curve: that is how a route changes lanes.
    """

    lane: LaneIndex
    command: Command = Command.FOLLOW
    enter_m: float = 0.0
    leave_m: float | None = None


def build_path(network: Network, legs: Sequence[Leg], goal_m: float) -> RoutePath:
    """Join legs into a path of points 1 m apart."""
    pieces, marks, owners = list[Floats](), list[tuple[float, float, Command]](), []
    done = 0.0
    # one dense piece a leg, a bridge where it starts elsewhere, its command's stretch
    for leg in legs:
        end = network.length(leg.lane) if leg.leave_m is None else leg.leave_m
        count = max(2, round((end - leg.enter_m) / FINE_M) + 1)
        stations = np.linspace(leg.enter_m, end, count)
        poses = [network.pose(leg.lane, float(s)) for s in stations]
        piece = np.array([(p.x, p.y) for p in poses])
        begin = done
        if pieces and np.hypot(*(piece[0] - pieces[-1][-1])) > 0.5:
            bridge = _bridge(pieces[-1], piece)
            pieces.append(bridge)
            done += _length(bridge)
            owners.append((done, leg))
        change_end = done
        pieces.append(piece)
        done += _length(piece)
        owners.append((done, leg))
        stop = change_end if leg.command in _CHANGES else done
        marks.append((begin - ANNOUNCED_M, stop, leg.command))
    # points 1 m apart, each with what its lane and the road beside it allow
    points = resample(_joined(pieces), SPACING_M)
    owner = _owner_of(len(points), owners)
    width = np.array([network.lane(legs[i].lane).width for i in owner], float)
    limit = np.array([network.lane(legs[i].lane).speed_limit for i in owner], float)
    headings = polyline_headings(points)
    left, right, oncoming = _room_beside(network, points, headings)
    return RoutePath(
        points,
        headings,
        width,
        limit,
        _commands(len(points), marks),
        goal_m,
        left,
        right,
        oncoming,
    )


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


def _length(points: Floats) -> float:
    return float(np.hypot(*np.diff(points, axis=0).T).sum())


def _joined(pieces: Sequence[Floats]) -> Floats:
    points = np.concatenate(pieces)
    steps = np.hypot(*np.diff(points, axis=0).T)
    return np.asarray(points[np.concatenate([[True], steps > 1e-6])])


def _owner_of(count: int, owners: Sequence[tuple[float, Leg]]) -> list[int]:
    ends = np.array([end for end, _ in owners])
    legs = list(dict.fromkeys(leg for _, leg in owners))
    index = np.searchsorted(ends, np.arange(count) * SPACING_M)
    index = np.minimum(index, len(owners) - 1)
    return [legs.index(owners[int(i)][1]) for i in index]


def _commands(
    count: int, marks: Sequence[tuple[float, float, Command]]
) -> npt.NDArray[np.int64]:
    commands = np.full(count, int(Command.FOLLOW), dtype=np.int64)
    stations = np.arange(count) * SPACING_M
    for begin, end, command in marks:
        if command is not Command.FOLLOW:
            commands[(stations >= begin) & (stations < end)] = int(command)
    return commands


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
    for sign, same_way, with_shoulder in (
        (1, True, False),
        (-1, True, True),
        (1, False, True),
    ):
        normal = np.stack([-np.sin(headings), np.cos(headings)], axis=1) * sign
        probes = points[:, None, :] + reach[None, :, None] * normal[:, None, :]
        flat = probes.reshape(-1, 2) @ np.diag(flip(1.0, 1.0))
        s, r = table.coordinates(flat)
        inside = (
            (s > -0.5)
            & (s < table.length + 0.5)
            & (np.abs(r) <= widths / 2 + TOUCHING_M)
        )
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
