"""Sampled futures of the ego: accelerations times lateral targets, and their costs.

Lateral targets are what the expert may aim at: lanes, nudges, the oncoming lane.
"""

import math
from dataclasses import dataclass

import numpy as np

from me2e_compress.simulator.plane_geometry import Command, Floats, RoutePath
from me2e_compress.simulator.scene import Ego
from me2e_compress.simulator.traffic.bodies import ACCELERATION_LAG_S
from models.driver.expert.forecast import TIMES_S, Flags, Forecast
from models.driver.expert.reentry import beyond, reentry

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


ACCELERATIONS_MPS2 = (-7.5, -5.5, -4.0, -2.8, -1.8, -1.0, -0.4, 0.0, 0.6, 1.2, 2.0)
STEPS = tuple(
    (step, math.exp(-step / ACCELERATION_LAG_S))
    for step in np.diff(TIMES_S, prepend=0.0).tolist()
)
"""Seconds of every step, and what is left of a missing acceleration after it."""
HARDEST_EASE_MPS2 = 3.0
"""Strongest braking for the speed ceiling."""
CHANGE_S = 2.6
"""Duration of a whole lane change; shorter shifts take less."""
SHORTEST_CHANGE_M = 9.0
FULL_CHANGE_M = 3.5


@dataclass(frozen=True, eq=False)
class SampledFutures:
    """K futures at the 18 times of `TIMES_S`; arrays are [K, T] or, from there on, [K].

    The heading is the body's: in a bend it differs from the direction of travel by the
    slip angle. ``lateral_m`` and ``target_m`` are metres left of the route,
    ``acceleration`` is the initial one, ``oncoming`` refers to the target's lane.
    """

    x: Floats
    y: Floats
    heading: Floats
    along_m: Floats
    lateral_m: Floats
    speed_mps: Floats
    acceleration: Floats
    target_m: Floats
    oncoming: Flags


def sample(
    path: RoutePath,
    top: Floats,
    ego: Ego,
    place: Place,
    options: Options,
    stop_m: float | None,
) -> SampledFutures:
    """Roll out every pair of acceleration and lateral target.

    ``top`` is the [N] speed ceiling along the route. ``stop_m`` is the arc length at
    which the ego's centre should stop, if any; it adds an acceleration that stops
    there.
    """
    # candidate accelerations, one of which stops at the line
    rates = list(ACCELERATIONS_MPS2)
    if stop_m is not None:
        room = max(stop_m - place.s_m, 0.05)
        rates.append(max(-(place.speed_mps**2) / (2 * room), -8.0))
    # every acceleration with every target
    along, speed = _speeds(top, place, np.array(rates))
    repeat, count = len(options.target_m), len(rates)
    along, speed = np.tile(along, (repeat, 1)), np.tile(speed, (repeat, 1))
    target = np.repeat(options.target_m, count)
    # offsets on the way to a target
    share = np.sqrt(np.abs(target - place.lateral_m) / FULL_CHANGE_M)
    seconds = CHANGE_S * np.clip(share, 0.6, 1.2)
    shortest = SHORTEST_CHANGE_M * np.maximum(share, 0.6)
    length = np.maximum(place.speed_mps * seconds, shortest)
    travel, slope = along - place.s_m, place.slope
    lateral = reentry(travel, place.lateral_m, slope, target, length)
    x, y, heading = beyond(path, along, lateral)
    # body heading: course minus slip angle
    moved = np.diff(along, axis=1, prepend=place.s_m)
    shifted = np.diff(lateral, axis=1, prepend=place.lateral_m)
    slip = np.clip(path.value(path.curvature, along) * ego.length / 2, -0.5, 0.5)
    heading = heading + np.arctan2(shifted, np.maximum(moved, 0.3)) - np.arcsin(slip)
    return SampledFutures(
        *(x, y, heading, along, lateral, speed),
        acceleration=np.tile(np.array(rates), repeat),
        target_m=target,
        oncoming=np.repeat(options.oncoming, count),
    )


def _speeds(top: Floats, place: Place, rates: Floats) -> tuple[Floats, Floats]:
    """Return arc lengths and speeds, each [rates, T], with the actuators' lag."""
    along = np.full_like(rates, max(place.s_m, 0.0))
    speed = np.full_like(rates, place.speed_mps)
    alongs, speeds = [], []
    missing = place.acceleration_mps2 - rates
    for step, left in STEPS:
        mean = rates + missing * (1 - left) * ACCELERATION_LAG_S / step
        missing = missing * left
        limit = top[np.minimum(along.astype(np.int64), len(top) - 1)]
        allowed = np.maximum(limit, speed - HARDEST_EASE_MPS2 * step)
        after = np.minimum(np.maximum(speed + mean * step, 0.0), allowed)
        along = along + (speed + after) / 2 * step
        speed = after
        alongs.append(along)
        speeds.append(speed)
    return np.stack(alongs, axis=1), np.stack(speeds, axis=1)


COLLISION, NEAR_MISS, CUT_OFF = 200.0, 8.0, 30.0
FADE = np.exp(-TIMES_S / 3.0)
"""[18] weights: later times weigh less."""
MARGIN_M, NEAR_M = 0.35, 1.3
"""Clearances that are enforced, and that are preferred."""
CORNER_M = 0.1
"""Added to the discs, which miss 0.41 m at the corners of the ego; less than
`MARGIN_M` remains."""
SWEEP_S = 0.12
"""Every box is this much longer at both ends, since the times are 0.25 s apart."""
REACH_M = 12.0
"""Half of two long vehicles and the margins; actors farther away are skipped."""
PRIORITY_S = 1.3
"""The way of a moving car is kept free for this time ahead of its bumper."""


def collision_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place
) -> Floats:
    """Return the [K] cost of touching, nearly touching, or cutting off an actor.

    The ego is four discs of its width; an actor is its rectangle, extended in front by
    its travel in `PRIORITY_S`. Followers in the ego's own lane are ignored.
    """
    # actors that come near any future of the ego
    margin = REACH_M + PRIORITY_S * seen.speed_mps[:, 1:]
    reach = np.ones_like(margin, bool)
    for mine, other in ((future.x, seen.x), (future.y, seen.y)):
        reach &= other[:, 1:] + margin > np.min(mine, axis=0)
        reach &= other[:, 1:] - margin < np.max(mine, axis=0)
    others = ~followers(seen, ego, place) & reach.any(axis=1)
    if not np.any(others):
        return np.zeros(len(future.acceleration))
    apart, cut = _clearances(future, seen, ego, others)
    worst = COLLISION * _worst(apart, MARGIN_M)
    worst += NEAR_MISS * _worst(apart, NEAR_M) + CUT_OFF * _worst(cut, MARGIN_M)
    return np.asarray(np.sum(worst, axis=0))


def followers(seen: Forecast, ego: Ego, place: Place) -> Flags:
    """Return [A] whether an actor follows the ego in a lane that the ego is in."""
    aligned = np.cos(seen.away[:, 0]) > 0.5
    apart = np.abs(seen.lateral_m[:, 0] - place.lateral_m)
    beside = apart < seen.half_breadth[:, 0] + ego.width / 2
    behind = seen.along_m[:, 0] < place.s_m
    return np.asarray(aligned & beside & behind & seen.yields)


def _worst(clearance: Floats, margin: float) -> Floats:
    """Return [A, K] the largest faded intrusion into a margin, 0 to 1."""
    inside = np.clip((margin - clearance) / margin, 0.0, 1.0)
    return np.asarray(np.max(inside * FADE, axis=-1))


def _clearances(
    future: SampledFutures, seen: Forecast, ego: Ego, others: Flags
) -> tuple[Floats, Floats]:
    """Return [A, K, T] metres from the ego to each actor, and to its way ahead."""
    # sizes of the ego's discs and of the actors' boxes
    radius = ego.width / 2 + CORNER_M
    reach = (ego.length - ego.width) / 2 + SWEEP_S * future.speed_mps
    x, y, heading, speed = (
        column[others, None, 1:]
        for column in (seen.x, seen.y, seen.heading, seen.speed_mps)
    )
    cos, sin = np.cos(heading), np.sin(heading)
    half_length = seen.length[others, None, None] / 2 + SWEEP_S * speed
    half_width = seen.width[others, None, None] / 2
    front = half_length + speed * PRIORITY_S * seen.moves[others, None, None]
    # squared distances from each disc, the smallest counts
    shift = reach * np.stack([np.cos(future.heading), np.sin(future.heading)])
    apart = np.full((len(x), *future.x.shape), np.inf)
    cut = apart.copy()
    for disc in (-1.0, -1 / 3, 1 / 3, 1.0):
        dx = (future.x + disc * shift[0])[None] - x
        dy = (future.y + disc * shift[1])[None] - y
        ahead, side = cos * dx, cos * dy
        ahead += sin * dy
        side -= sin * dx
        side = _squared_beyond(np.abs(side, out=side), half_width)
        # in place: these arrays are most of what a decision takes
        way = np.maximum(ahead - front, -half_length - ahead)
        way = _squared_beyond(way, 0.0)
        end = _squared_beyond(np.abs(ahead, out=ahead), half_length)
        end += side
        way += side
        np.minimum(apart, end, out=apart)
        np.minimum(cut, way, out=cut)
    return np.sqrt(apart) - radius, np.sqrt(cut) - radius


def _squared_beyond(away: Floats, half: Floats | float) -> Floats:
    """Return the squares of what exceeds a half extent, in place."""
    away -= half
    np.maximum(away, 0.0, out=away)
    away *= away
    return away


OFF_ROAD, RUN_LINE, WRONG_SIDE, HEADWAY = 120.0, 500.0, 1.5, 24.0
PROGRESS_PER_M, SPEED_PER_MPS = 0.40, 0.8
OFFSET_PER_M, NUDGE_PER_M, SWITCH = 0.6, 0.3, 3.0
BRAKE_HARD, EFFORT, JERK = 3.0, 0.4, 0.15
LANE_CHANGE_M = 1.6
"""Targets farther apart than this are different lanes."""
STANDOFF_M, GAP_S = 2.0, 0.8
"""Distance kept to a leader: standing, and seconds of travel."""
SWING_OUT_M = 8.0
"""Standing distance to an obstacle that has to be driven around."""
BESIDE_M = 0.3
"""An actor that is passed with less room than this is a leader."""
EMERGENCY, EMERGENCY_PER_MPS, EMERGENCY_SHARE, EMERGENCY_M = 60.0, 4.0, 0.35, 60.0
"""Staying in the way of an emergency vehicle that is this near behind, or driving
faster than this share of its speed."""


def rule_cost(
    future: SampledFutures,
    path: RoutePath,
    ego: Ego,
    place: Place,
    stop_m: float | None,
) -> Floats:
    """Return the [K] cost of leaving the road, the wrong side, and stop lines.

    An ego that is already off the road pays only for going farther.
    """
    # edges of the road along each future
    half = ego.width / 2 - 0.05
    metre = np.clip(np.rint(future.along_m).astype(np.int64), 0, len(path.left_m) - 1)
    left, both, right = path.left_m[metre], path.oncoming_m[metre], path.right_m[metre]
    edge = np.where(future.oncoming[:, None], both, left)
    over = np.maximum(future.lateral_m + half - both, -right - future.lateral_m + half)
    # how far off the road the ego already is
    already = max(
        place.lateral_m + half - float(path.value(path.oncoming_m, place.s_m)),
        half - place.lateral_m - float(path.value(path.right_m, place.s_m)),
        0.0,
    )
    wrong = np.clip(future.lateral_m + half - edge, 0.0, 1.0)
    # road edge, oncoming lane, stop line
    cost = OFF_ROAD * np.max(np.clip(over - already, 0.0, 1.0) * FADE, axis=1)
    cost += WRONG_SIDE * np.sum(wrong * FADE, axis=1)
    if stop_m is not None:
        cost += RUN_LINE * (np.max(future.along_m, axis=1) > stop_m + 0.25)
    return np.asarray(cost)


def headway_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place, passable: bool
) -> Floats:
    """Return the [K] cost of driving too close to a leader or an obstacle.

    On a passable road a slow leader is followed with room to swing out.
    """
    # leaders: actors ahead in the ego's way, among those that can be
    room = seen.half_breadth[:, 1:] + ego.width / 2 + BESIDE_M
    sideways = seen.lateral_m[:, 1:]
    inside = sideways + room > np.min(future.lateral_m)
    inside &= sideways - room < np.max(future.lateral_m)
    inside &= seen.along_m[:, 1:] > np.min(future.along_m)
    may = inside.any(axis=1) & ~followers(seen, ego, place)
    along, lateral = (part[may, None, 1:] for part in (seen.along_m, seen.lateral_m))
    ahead = along - future.along_m[None]
    leads = np.abs(lateral - future.lateral_m[None]) < room[may, None]
    leads &= ahead > 0
    gap = ahead - seen.half_span[may, None, 1:] - ego.length / 2
    # the gap that is missing, of the worst leader
    slow = (np.max(seen.speed_mps[may], axis=1) < SLOW_MPS)[:, None, None]
    standing = np.where(slow & passable, SWING_OUT_M, STANDOFF_M)
    wanted = standing + GAP_S * future.speed_mps[None]
    short = np.where(leads, np.clip((wanted - gap) / wanted, 0.0, 1.2), 0.0)
    closest = np.max(short, axis=0, initial=0.0)
    return np.asarray(HEADWAY * np.mean(closest, axis=1))


def emergency_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place
) -> Floats:
    """Return the [K] cost of holding up an emergency vehicle from behind.

    The ego first leaves its lane, then slows down.
    """
    # emergency vehicles close behind
    behind = place.s_m - seen.along_m[:, 0]
    urgent = seen.emergency & (behind > -ego.length) & (behind < EMERGENCY_M)
    urgent &= (np.cos(seen.away[:, 0]) > 0.5) & (seen.speed_mps[:, 0] > SLOW_MPS)
    if not np.any(urgent):
        return np.zeros(len(future.acceleration))
    # cost of blocking their lane, and of not slowing down
    lateral, speed = seen.lateral_m[urgent][:, -1], np.min(seen.speed_mps[urgent])
    room = ego.width / 2 + seen.width[urgent] / 2 + BESIDE_M
    blocked = np.abs(future.lateral_m[:, -1, None] - lateral) < room
    hasty = np.maximum(future.speed_mps[:, -1] - EMERGENCY_SHARE * speed, 0.0)
    return np.asarray(EMERGENCY * np.any(blocked, axis=1) + EMERGENCY_PER_MPS * hasty)


def drive_cost(future: SampledFutures, ego: Ego, place: Place, kept_m: float) -> Floats:
    """Return the [K] cost of little progress, effort, and changes of target."""
    rate = future.acceleration
    begun = (future.speed_mps[:, 1] - place.speed_mps) / 0.5
    # progress and speed are gains
    cost = -PROGRESS_PER_M * (future.along_m[:, -1] - place.s_m)
    cost -= SPEED_PER_MPS * future.speed_mps[:, -1]
    # effort and jerk
    cost += EFFORT * np.abs(rate) + BRAKE_HARD * (rate < -3.5)
    cost += JERK * np.abs(begun - ego.acceleration_mps2)
    # offsets and changes of the lateral target
    cost += OFFSET_PER_M * np.abs(future.target_m)
    moved = np.abs(future.target_m - kept_m)
    cost += np.where(moved > LANE_CHANGE_M, SWITCH, NUDGE_PER_M * moved)
    return np.asarray(cost)
