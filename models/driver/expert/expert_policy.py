"""The expert policy, and its decision as a pure function."""

from collections.abc import Iterable
from dataclasses import dataclass, field

import numpy as np

from me2e_compress.driving.contract import Observation, Plan, RouteInfo
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Scene, SignalKind, SignalState
from models.driver.expert.forecast import (
    NOW_S,
    TIMES_S,
    Forecast,
    forecast,
    near,
)
from models.driver.expert.futures import (
    Place,
    collision_cost,
    drive_cost,
    emergency_cost,
    headway_cost,
    lateral_targets,
    rule_cost,
    sample,
)
from models.driver.expert.privileged import (
    Phase,
    Privileged,
    privileged,
    scene_and_world,
)
from models.driver.expert.reentry import slope_of
from models.driver.expert.visibility import seen

LATERAL_MPS2 = 2.2
"""Lateral acceleration in bends; the comfort bound of nuPlan is 4.89."""
EASE_MPS2 = 1.8
"""Braking ahead of a bend or a lower limit."""
SLOWEST_MPS = 2.5
"""Lowest speed that a bend demands."""


def ceiling(path: RoutePath) -> Floats:
    """Return [N] the highest speed (m/s) at every metre of a route without traffic."""
    window = np.full(5, 0.2)
    # curvature, averaged over 5 m
    bends = np.convolve(np.pad(np.abs(path.curvature), 2, mode="edge"), window, "valid")
    in_bend = np.sqrt(LATERAL_MPS2 / np.maximum(bends, 1e-4))
    top = np.minimum(path.speed_limits_mps, np.maximum(in_bend, SLOWEST_MPS))
    # brake in time for lower limits ahead
    for i in range(len(top) - 2, -1, -1):
        top[i] = min(top[i], np.sqrt(top[i + 1] ** 2 + 2 * EASE_MPS2))
    return top


STANDING_MPS = 0.08
"""Below this the ego has stopped; Bench2Drive asks for less than 0.1 m/s."""
BEFORE_LINE_M = 1.0
"""Room left between the front bumper and the line."""
SERVED_WITHIN_M = 4.0
"""A stop counts if the bumper is at most this far from the line."""
YELLOW_MPS2 = 3.0
"""A yellow light is obeyed if braking no harder than this stops in time."""
GIVE_WAY_S = 2.4
"""No priority traffic is met within this time after crossing a give-way line."""
CONFLICT_M, MEETING_M = 30.0, 2.0
"""Range behind the line, and beside the route, of priority traffic."""
GIVE_WAY_MPS = 5.0
"""Speed at a give-way line: slow enough to stop for priority traffic."""


@dataclass(frozen=True)
class Stop:
    """Arc lengths where the ego's centre must stop, or slow to `GIVE_WAY_MPS`, if any.

    ``served`` are the stop signs at which it has stopped.
    """

    line_m: float | None
    slow_m: float | None
    served: frozenset[int]


def obey(
    scene: Scene,
    phases: Iterable[Phase],
    seen: Forecast,
    ego_s_m: float,
    served: frozenset[int],
) -> Stop:
    """Return where the signals ahead on the route make the ego stop or slow down."""
    ego, lines, slow = scene.ego, list[float](), list[float]()
    # signals on the route whose line is still ahead
    line_of = {phase.signal_id: phase.line_s for phase in phases}
    for signal in scene.signals:
        line = line_of.get(signal.id)
        if line is None:
            continue
        gap = line - ego.length / 2 - ego_s_m
        if gap < 0:
            continue
        # a stop sign is served once the ego has stopped near its line
        if signal.kind is SignalKind.STOP_SIGN and gap <= SERVED_WITHIN_M:
            stands = ego.speed_mps < STANDING_MPS
            served = served | {signal.id} if stands else served
        # a give-way line slows the ego, and stops it for traffic
        if signal.kind is SignalKind.GIVE_WAY:
            slow.append(line - ego.length / 2)
            # when its front is there, at its speed or from rest at 2 m/s2
            arrival = float(min(gap / max(ego.speed_mps, 0.1), np.sqrt(gap)))
            if must_give_way(seen, line, arrival):
                lines.append(line - ego.length / 2 - min(BEFORE_LINE_M, gap))
        closed = signal.state is SignalState.RED
        if signal.kind is SignalKind.STOP_SIGN:
            closed = signal.id not in served
        elif signal.state is SignalState.YELLOW:
            closed = ego.speed_mps**2 / (2 * max(gap, 0.1)) < YELLOW_MPS2
        if closed:
            lines.append(line - ego.length / 2 - min(BEFORE_LINE_M, gap))
    return Stop(min(lines, default=None), min(slow, default=None), served)


def must_give_way(seen: Forecast, line_m: float, crossing_s: float) -> bool:
    """Return whether priority traffic meets the route when the ego crosses a line."""
    in_reach = (seen.along_m > line_m) & (seen.along_m < line_m + CONFLICT_M)
    meets = in_reach & (np.abs(seen.lateral_m) < MEETING_M)
    meets &= (seen.speed_mps[:, :1] > 0.5) & ~seen.walks[:, None]
    first = np.argmax(meets, axis=1)
    leads = meets[:, 0] & (np.cos(seen.away[:, 0]) > 0.8)
    due = NOW_S[first] - crossing_s
    soon = (due > -0.5 - GIVE_WAY_S / 2) & (due < GIVE_WAY_S)
    return bool(np.any(meets.any(axis=1) & ~leads & soon))


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
    scene: Scene, known: Privileged, path: RoutePath, top: Floats, memory: Memory
) -> ExpertDecision:
    """Plan from any state.

    ``known`` are the actors' intents and the signals on the route, ``top`` is the [N]
    speed ceiling along the route from `ceiling`, ``memory`` comes from the
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
    # futures: accelerations times lateral targets, slower before a give-way line
    if stop.slow_m is not None:
        before = stop.slow_m - np.arange(len(top))
        slow = np.sqrt(GIVE_WAY_MPS**2 + 2 * EASE_MPS2 * np.maximum(before, 0.0))
        top = np.where(before < 0, top, np.minimum(top, slow))
    future = sample(path, top, ego, place, options, stop.line_m)
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
        known = privileged(world, {actor.id for actor in near(scene)})
        self.last = decide(scene, known, world.path, self._top, memory)
        return self.last.waypoints
