"""One decision of the expert: a pure function of what it is told."""

from dataclasses import dataclass

import numpy as np

from me2e_compress.driving.contract import Plan
from me2e_compress.evaluators.highway.expert.collisions import collision_cost
from me2e_compress.evaluators.highway.expert.costs import (
    drive_cost,
    emergency_cost,
    headway_cost,
    rule_cost,
)
from me2e_compress.evaluators.highway.expert.forecast import TIMES_S, forecast
from me2e_compress.evaluators.highway.expert.futures import sample
from me2e_compress.evaluators.highway.expert.lateral_targets import (
    Place,
    lateral_targets,
)
from me2e_compress.evaluators.highway.expert.speed import EASE_MPS2
from me2e_compress.evaluators.highway.expert.stops import GIVE_WAY_MPS, Stop, obey
from me2e_compress.evaluators.highway.reference import in_ego_frame, slope_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import RoutePath, Scene
from me2e_compress.simulator.world.privileged import Privileged

WAYPOINTS = np.searchsorted(TIMES_S, np.arange(0.5, 3.01, 0.5))
"""[6] columns of the candidates that are handed out."""


@dataclass(frozen=True)
class Memory:
    """What one decision leaves to the next; the default is no past at all.

    Args:
        at_m: Arc length at which the ego was last seen.
        target_m: Lateral target of the last plan (hysteresis).
        served: Stop signs at which the ego has stopped.
    """

    at_m: float | None = None
    target_m: float = 0.0
    served: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class ExpertDecision:
    """What the expert decided.

    Args:
        waypoints: [6, 2] metres in the ego frame, every 0.5 s.
        acceleration_mps2: What the chosen future begins with.
        target_m: Metres left of the route at which it aims.
        cost: Of the chosen future.
        memory: For the next decision.
    """

    waypoints: Plan
    acceleration_mps2: float
    target_m: float
    cost: float
    memory: Memory


def decide(
    scene: Scene,
    known: Privileged,
    path: RoutePath,
    top: Floats,
    memory: Memory,
) -> ExpertDecision:
    """Plan from any state.

    Args:
        scene: What there is.
        known: What the actors mean to do, and which signals are on the route.
        path: The route.
        top: [N] speed ceiling along it, of `speed.ceiling`.
        memory: What the last decision left, or ``Memory()``.
    """
    ego = scene.ego
    s, lateral = path.project(ego.x, ego.y, memory.at_m)
    speed = max(ego.speed_mps, 0.0)
    here = float(path.value(top, s))
    slope, gaining = slope_of(ego, path, s), ego.acceleration_mps2
    place = Place(s, lateral, slope, speed, gaining, here)
    intents = {intent.actor_id: intent for intent in known.intents}
    seen = forecast(scene, intents, path, s)
    stop = obey(scene, known.phases, seen, s, memory.served)
    options = lateral_targets(path, place, ego, seen)
    future = sample(path, _slowed(top, stop), ego, place, options, stop.line_m)
    cost = drive_cost(future, ego, place, memory.target_m)
    cost += rule_cost(future, path, ego, place, stop.line_m)
    if len(seen.length):
        cost += collision_cost(future, seen, ego, place)
        cost += headway_cost(future, seen, ego, place, options.passable)
        cost += emergency_cost(future, seen, ego, place)
    best = int(np.argmin(cost))
    target = float(future.target_m[best])
    columns = future.x[best, WAYPOINTS], future.y[best, WAYPOINTS]
    return ExpertDecision(
        in_ego_frame(*columns, ego),
        float(future.acceleration[best]),
        target,
        float(cost[best]),
        Memory(s, target, stop.served),
    )


def _slowed(top: Floats, stop: Stop) -> Floats:
    """The ceiling with a give-way line ahead, if there is one."""
    if stop.slow_m is None:
        return top
    before = np.maximum(stop.slow_m - np.arange(len(top)), 0.0)
    slow = np.sqrt(GIVE_WAY_MPS**2 + 2 * EASE_MPS2 * before)
    past = np.arange(len(top)) > stop.slow_m
    return np.where(past, top, np.minimum(top, slow))
