"""Lateral offsets that the expert may aim at: lanes, nudges, oncoming lane."""

from dataclasses import dataclass

import numpy as np

from me2e_compress.evaluators.highway.expert.forecast import Flags, Forecast
from me2e_compress.simulator.plane_geometry import Command, Floats, RoutePath
from me2e_compress.simulator.scene import Ego

NUDGES_M = (0.5, -0.5, 1.0, -1.0)
"""Small shifts within the drivable width: past a door, away from a car that cuts the
bend."""
ASIDE_M = 0.7
"""Shift within the lane beside, away from what is passed."""
JUNCTION = (int(Command.LEFT), int(Command.RIGHT), int(Command.STRAIGHT))
"""Commands under which the expert does not overtake."""
SLOW_MPS = 3.0
"""Slower actors in the own lane are passed, not followed."""
CHAIN_M = 14.0
"""Obstacles closer to each other than this are passed in one go."""
CLEAR_S = 1.0
"""Time to spare between the return and the oncoming car."""
FACING = 0.75
"""Who is so many lanes from the middle of the oncoming lane is beside the road."""
PASS_MPS2 = 1.8
"""Acceleration while passing."""


@dataclass(frozen=True)
class Place:
    """The ego on its route; ``lateral_m`` is positive to the left.

    ``slope`` is that of `reentry.slope_of`, ``top_mps`` the speed that the road allows.
    """

    s_m: float
    lateral_m: float
    slope: float
    speed_mps: float
    acceleration_mps2: float
    top_mps: float


@dataclass(frozen=True, eq=False)
class Options:
    """Lateral targets [L], metres left of the route.

    ``passable`` tells whether there is any lane beside the own one, now or later.
    """

    target_m: Floats
    oncoming: Flags
    passable: bool


@dataclass(frozen=True)
class Block:
    """An obstruction of the ego's lane, with distances from the ego's centre."""

    start_m: float
    end_m: float
    speed_mps: float


def lateral_targets(path: RoutePath, place: Place, ego: Ego, seen: Forecast) -> Options:
    """Return the lateral offsets that the road a little ahead allows.

    The oncoming lane is offered only if the own lane is blocked and there is a gap, or
    if the ego is already in it.
    """
    # widths of the road where the ego will be shortly
    ahead = place.s_m + max(6.0, 0.8 * place.speed_mps)
    columns = (path.lane_widths, path.left_m, path.right_m, path.oncoming_m)
    lane, left, right, both = (float(path.value(c, ahead)) for c in columns)
    room = ego.width / 2
    # nudges and neighbouring lanes that fit into the width
    beside = [lane, min(lane + ASIDE_M, left - room), 2 * lane]
    beside += [-lane, max(-lane - ASIDE_M, room - right), -2 * lane]
    offsets = [n for n in (*NUDGES_M, *beside) if room - right <= n <= left - room]
    oncoming = [False] * (1 + len(offsets))
    # the oncoming lane
    facing = left + lane / 2
    around = both > facing + room
    may_face = around and left < 1.4 * lane
    if may_face and place.lateral_m + ego.width / 2 <= left + 0.3:
        # it is entered where the own lane is blocked, off junctions, with a gap
        block = blocked_stretch(place, ego, seen)
        if block is None or block.start_m > max(30.0, 3.0 * place.speed_mps):
            may_face = False
        else:
            low, high = int(max(place.s_m, 0.0)), int(place.s_m + block.end_m + 6.0)
            junction = np.isin(path.commands[low:high], JUNCTION).any()
            gap = place, ego, seen, block, left, lane
            may_face = not junction and gap_for_passing(*gap)
    if may_face:
        extra = [facing + n for n in (0.0, ASIDE_M) if facing + n + room <= both]
        offsets, oncoming = offsets + extra, oncoming + [True] * len(extra)
    passable = around or max(left, right) > 1.4 * lane
    return Options(np.array([0.0, *offsets]), np.array(oncoming), passable)


def gap_for_passing(
    place: Place, ego: Ego, seen: Forecast, block: Block, left_m: float, lane_m: float
) -> bool:
    """Return whether the blocker can be passed before oncoming traffic arrives.

    The ego must be past the blockers before the first oncoming car gets there, with
    `CLEAR_S` to spare.
    """
    # distance and time of passing a blocker that moves on
    top, seconds = min(place.top_mps, 10.0), 0.0
    beside = block.end_m + ego.length + 6.0
    distance = beside
    for _ in range(3):
        distance = beside + block.speed_mps * seconds
        seconds = _seconds_for(distance, place.speed_mps, top)
    # when oncoming cars reach the end of that stretch
    gap = seen.along_m[:, 0] - place.s_m
    coming = (np.cos(seen.away[:, 0]) < -0.5) & (seen.speed_mps.max(axis=1) > 0.5)
    coming &= np.abs(seen.lateral_m[:, 0] - left_m - lane_m / 2) < FACING * lane_m
    coming &= (gap > -2.0) & ~seen.walks
    closing = np.maximum(seen.speed_mps.max(axis=1), 3.0)
    arrival = (gap - seen.length / 2 - distance) / closing
    return bool(np.all(arrival[coming] > seconds + CLEAR_S))


def blocked_stretch(place: Place, ego: Ego, seen: Forecast) -> Block | None:
    """Find what has to be driven around; None if the lane is free.

    That is anything slow along the centre line (0.3 m to spare) that does not cross it;
    neighbours within `CHAIN_M` count as one.
    """
    # slow actors in the way that do not cross it
    lateral, half = seen.lateral_m[:, 0], seen.half_breadth[:, 0]
    fastest = np.max(seen.speed_mps[:, :9], axis=1)
    crosses = (np.abs(np.sin(seen.away[:, 0])) > 0.5) & (fastest > 0.3)
    in_way = np.abs(lateral) < half + ego.width / 2 + 0.3
    gap = seen.along_m[:, 0] - place.s_m
    ends = gap + seen.half_span[:, 0]
    slow = (fastest < SLOW_MPS) & (seen.goal_mps < SLOW_MPS + 1.0)
    blocking = in_way & slow & ~crosses & ~seen.walks
    blocking &= ends > -ego.length / 2
    if not np.any(blocking):
        return None
    # chain neighbours, starting with the nearest
    order = np.argsort(gap[blocking])
    starts = (gap - seen.half_span[:, 0])[blocking][order]
    stops = ends[blocking][order]
    end = float(stops[0])
    for begin, stop in zip(starts[1:], stops[1:], strict=True):
        if begin - end > CHAIN_M:
            break
        end = max(end, float(stop))
    return Block(float(starts[0]), end, float(np.max(fastest[blocking])))


def _seconds_for(distance_m: float, speed: float, top: float) -> float:
    """Return the time for a distance from a speed, accelerating to ``top``."""
    top = max(top, speed, 1.0)
    ramp_s = (top - speed) / PASS_MPS2
    ramp_m = (speed + top) / 2 * ramp_s
    if ramp_m >= distance_m:
        return float(
            (np.sqrt(speed**2 + 2 * PASS_MPS2 * distance_m) - speed) / PASS_MPS2
        )
    return ramp_s + (distance_m - ramp_m) / top
