"""What each sampled future costs besides collisions: rules, progress, comfort.

The weights were chosen by hand: a collision outweighs a rule, a rule outweighs
progress, progress outweighs comfort.
"""

import numpy as np

from me2e_compress.evaluators.highway.expert.collisions import FADE, followers
from me2e_compress.evaluators.highway.expert.forecast import Forecast
from me2e_compress.evaluators.highway.expert.futures import SampledFutures
from me2e_compress.evaluators.highway.expert.lateral_targets import SLOW_MPS, Place
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Ego, RoutePath

OFF_ROAD, RUN_LINE, WRONG_SIDE, HEADWAY = 120.0, 500.0, 1.5, 24.0
PROGRESS_PER_M, SPEED_PER_MPS = 0.40, 0.8
OFFSET_PER_M, NUDGE_PER_M, SWITCH = 0.6, 0.3, 3.0
BRAKE_HARD, EFFORT, JERK = 3.0, 0.4, 0.15
LANE_CHANGE_M = 1.6
"""Targets farther apart than this are different lanes: the expert hesitates."""
STANDOFF_M, GAP_S = 2.0, 0.8
"""Distance kept to a leader: standing, and per m/s."""
SWING_OUT_M = 8.0
"""Standing distance to an obstacle that has to be driven around."""
BESIDE_M = 0.3
"""A leader is whoever is not passed with this much room."""
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
    """[K] cost of leaving the road, of the wrong side, and of passing a stop line.

    Who is off the road already pays only for going farther.
    """
    half = ego.width / 2 - 0.05
    metre = np.clip(np.rint(future.along_m).astype(np.int64), 0, len(path.left_m) - 1)
    left, both, right = path.left_m[metre], path.oncoming_m[metre], path.right_m[metre]
    edge = np.where(future.oncoming[:, None], both, left)
    over = np.maximum(future.lateral_m + half - both, -right - future.lateral_m + half)
    already = max(
        place.lateral_m + half - float(path.value(path.oncoming_m, place.s_m)),
        half - place.lateral_m - float(path.value(path.right_m, place.s_m)),
        0.0,
    )
    wrong = np.clip(future.lateral_m + half - edge, 0.0, 1.0)
    cost = OFF_ROAD * np.max(np.clip(over - already, 0.0, 1.0) * FADE, axis=1)
    cost += WRONG_SIDE * np.sum(wrong * FADE, axis=1)
    if stop_m is not None:
        cost += RUN_LINE * (np.max(future.along_m, axis=1) > stop_m + 0.25)
    return np.asarray(cost)


def headway_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place, passable: bool
) -> Floats:
    """[K] cost of driving too close behind somebody, or up to an obstacle.

    What is slow on a passable road is followed at the distance that lets the
    ego swing out.
    """
    along, lateral = seen.along_m[:, None, 1:], seen.lateral_m[:, None, 1:]
    ahead = along - future.along_m[None]
    room = seen.half_breadth[:, None, 1:] + ego.width / 2 + BESIDE_M
    leads = (np.abs(lateral - future.lateral_m[None]) < room) & (ahead > 0)
    leads &= (~followers(seen, ego, place))[:, None, None]
    gap = ahead - seen.half_span[:, None, 1:] - ego.length / 2
    slow = (np.max(seen.speed_mps, axis=1) < SLOW_MPS)[:, None, None]
    standing = np.where(slow & passable, SWING_OUT_M, STANDOFF_M)
    wanted = standing + GAP_S * future.speed_mps[None]
    short = np.where(leads, np.clip((wanted - gap) / wanted, 0.0, 1.2), 0.0)
    closest = np.max(short, axis=0, initial=0.0)
    return np.asarray(HEADWAY * np.mean(closest, axis=1))


def emergency_cost(
    future: SampledFutures, seen: Forecast, ego: Ego, place: Place
) -> Floats:
    """[K] cost of not letting an emergency vehicle pass that comes from behind.

    First the ego leaves its lane, then it slows down.
    """
    behind = place.s_m - seen.along_m[:, 0]
    urgent = seen.emergency & (behind > -ego.length) & (behind < EMERGENCY_M)
    urgent &= (np.cos(seen.away[:, 0]) > 0.5) & (seen.speed_mps[:, 0] > SLOW_MPS)
    if not np.any(urgent):
        return np.zeros(len(future.acceleration))
    lateral, speed = seen.lateral_m[urgent][:, -1], np.min(seen.speed_mps[urgent])
    room = ego.width / 2 + seen.width[urgent] / 2 + BESIDE_M
    blocked = np.abs(future.lateral_m[:, -1, None] - lateral) < room
    hasty = np.maximum(future.speed_mps[:, -1] - EMERGENCY_SHARE * speed, 0.0)
    return np.asarray(EMERGENCY * np.any(blocked, axis=1) + EMERGENCY_PER_MPS * hasty)


def drive_cost(future: SampledFutures, ego: Ego, place: Place, kept_m: float) -> Floats:
    """[K] lack of progress, effort, and restlessness.

    Args:
        future: The sampled futures.
        ego: The ego.
        place: The same on its route.
        kept_m: The lateral target of the last plan.
    """
    rate = future.acceleration
    begun = (future.speed_mps[:, 1] - place.speed_mps) / 0.5
    cost = -PROGRESS_PER_M * (future.along_m[:, -1] - place.s_m)
    cost -= SPEED_PER_MPS * future.speed_mps[:, -1]
    cost += EFFORT * np.abs(rate) + BRAKE_HARD * (rate < -3.5)
    cost += JERK * np.abs(begun - ego.acceleration_mps2)
    cost += OFFSET_PER_M * np.abs(future.target_m)
    moved = np.abs(future.target_m - kept_m)
    cost += np.where(moved > LANE_CHANGE_M, SWITCH, NUDGE_PER_M * moved)
    return np.asarray(cost)
