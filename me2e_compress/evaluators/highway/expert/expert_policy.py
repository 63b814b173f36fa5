"""The expert policy, and its decision as a pure function."""

from dataclasses import dataclass, field

import numpy as np

from me2e_compress.driving.contract import Observation, Plan, RouteInfo
from me2e_compress.evaluators.highway.expert.forecast import TIMES_S, forecast, near
from me2e_compress.evaluators.highway.expert.future_costs import (
    collision_cost,
    drive_cost,
    emergency_cost,
    headway_cost,
    rule_cost,
)
from me2e_compress.evaluators.highway.expert.futures import sample
from me2e_compress.evaluators.highway.expert.lateral_targets import (
    Place,
    lateral_targets,
)
from me2e_compress.evaluators.highway.expert.speed_limits import (
    ceiling,
    obey,
    slowed,
)
from me2e_compress.evaluators.highway.observe import scene_and_world, seen
from me2e_compress.evaluators.highway.reentry import slope_of
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Scene
from me2e_compress.simulator.world import Privileged

WAYPOINTS = np.searchsorted(TIMES_S, np.arange(0.5, 3.01, 0.5))
"""[6] columns of the candidates that become waypoints."""


@dataclass(frozen=True)
class Memory:
    """State that one decision passes to the next; empty by default.

    It holds the last arc length, the last lateral target (hysteresis), and the stop
    signs at which the ego has stopped.
    """

    at_m: float | None = None
    target_m: float = 0.0
    served: frozenset[int] = frozenset()


@dataclass(frozen=True, eq=False)
class ExpertDecision:
    """A decision of the expert.

    The waypoints are [6, 2] metres in the ego frame, every 0.5 s; ``acceleration_mps2``
    is the initial one, ``target_m`` the lateral target, metres left of the route.
    """

    waypoints: Plan
    acceleration_mps2: float
    target_m: float
    memory: Memory


def decide(
    scene: Scene,
    known: Privileged,
    path: RoutePath,
    top: Floats,
    memory: Memory,
) -> ExpertDecision:
    """Plan from any state.

    ``known`` are the actors' intents and the signals on the route, ``top`` is the [N]
    speed ceiling along the route from `speed_limits.ceiling`, ``memory`` comes from the
    last decision, or is ``Memory()``.
    """
    # where the ego is on its route
    ego = scene.ego
    s, lateral = path.project(ego.x, ego.y, memory.at_m)
    speed = max(ego.speed_mps, 0.0)
    here = float(path.value(top, s))
    slope, gaining = slope_of(ego, path, s), ego.acceleration_mps2
    place = Place(s, lateral, slope, speed, gaining, here)
    # what the others will do, where signals stop the ego, which offsets are open
    intents = {intent.actor_id: intent for intent in known.intents}
    seen = forecast(scene, intents, path, s)
    stop = obey(scene, known.phases, seen, s, memory.served)
    options = lateral_targets(path, place, ego, seen)
    # futures: accelerations times lateral targets
    future = sample(path, slowed(top, stop), ego, place, options, stop.line_m)
    # what each costs
    cost = drive_cost(future, ego, place, memory.target_m)
    cost += rule_cost(future, path, ego, place, stop.line_m)
    if len(seen.length):
        cost += collision_cost(future, seen, ego, place)
        cost += headway_cost(future, seen, ego, place, options.passable)
        cost += emergency_cost(future, seen, ego, place)
    # the cheapest one, as waypoints
    best = int(np.argmin(cost))
    target = float(future.target_m[best])
    columns = future.x[best, WAYPOINTS], future.y[best, WAYPOINTS]
    return ExpertDecision(
        ego.seen(*columns),
        float(future.acceleration[best]),
        target,
        Memory(s, target, stop.served),
    )


@dataclass
class Expert:
    """Drives by `decide`, and keeps its target lane and the signs it obeyed.

    ``last`` is the last decision, for labels and pictures; None before the first. With
    ``cameras_only`` it knows nothing of actors and signals that no camera shows.
    """

    cameras_only: bool = False
    needs_images: bool = field(default=False, init=False)
    privileged: bool = field(default=True, init=False)
    last: ExpertDecision | None = field(default=None, init=False)
    _path: RoutePath | None = field(default=None, init=False, repr=False)
    _top: Floats | None = field(default=None, init=False, repr=False)

    def reset(self, route: RouteInfo) -> None:
        """Forget the last route."""
        self.last = self._path = self._top = None

    def plan(self, observation: Observation) -> Plan:
        """Return six waypoints [6, 2], metres in the ego frame, every 0.5 s."""
        scene, world = scene_and_world(observation, "driver expert")
        if self._top is None or self._path is not world.path:
            self._path, self._top = world.path, ceiling(world.path)
        memory = Memory() if self.last is None else self.last.memory
        if self.cameras_only:
            scene = seen(scene)
        known = world.privileged({actor.id for actor in near(scene)})
        self.last = decide(scene, known, world.path, self._top, memory)
        return self.last.waypoints
