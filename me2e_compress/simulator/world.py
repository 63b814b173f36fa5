"""One route, stepped frame by frame."""

import math

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.episode import Ending
from me2e_compress.simulator.plane_geometry import Roadmap, RoutePath
from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.builders import Builder, stage_of
from me2e_compress.simulator.scene import (
    Actor,
    Control,
    Event,
    EventKind,
    Scene,
    SignalKind,
)
from me2e_compress.simulator.traffic.bodies import Car, StaticObject, Walker
from me2e_compress.simulator.traffic.right_of_way import RightOfWay
from me2e_compress.simulator.traffic.traffic_road import TrafficRoad

DT_US = 50_000  # 20 Hz, as Bench2Drive
DECISION_US = 100_000  # actors decide at 10 Hz and move at the frame rate
TOLERANCE_M = 0.5  # of the ego's centre outside lanes (OutsideRouteLanesTest)
# Contact with an ego slower than this is no collision of the ego's, and the route goes
# on: CollisionTest in Bench2Drive's atomic_criteria.py
STANDING_MPS = 0.1


class World:
    """A route of highway-env's roads and vehicles, driven by `Control`.

    The same route gives the same bytes, whatever ran before in the process: every
    random number comes from the route's seed and no class attribute is written.

    Args:
        route: What to stage.
        dt_us: Frame length in microseconds. A finer one takes controls more often;
            actors still decide every 0.1 s.
        builder: Sets the stage, traffic included, instead of the registered scenario
            type: for new types.
    """

    def __init__(
        self, route: Route, *, dt_us: int = DT_US, builder: Builder | None = None
    ) -> None:
        if not 0 < dt_us <= DECISION_US:
            raise EvaluationError(
                f"frame of {dt_us} us: it must be between 1 and {DECISION_US}"
            )
        self.route, self.dt_us = route, dt_us
        # The scenario sets the stage: bodies, signals and the route, right-handed
        self.stage = stage = stage_of(route, builder)
        self.path: RoutePath = stage.path
        self.parameters, self.weather = dict(stage.parameters), stage.weather
        self.roadmap: Roadmap = stage.network.roadmap(
            tuple(signal.snapshot().stop_line for signal in stage.regulators),
            tuple(stage.crosswalks),
        )
        # Traffic
        rules = RightOfWay(stage.network, stage.schedule.lines, stage.ego_lanes)
        self._road = TrafficRoad(stage.network, rules)
        self._road.vehicles = [stage.ego]
        self._next_decision_us = 0
        self._still = list[Actor]()  # static objects: they stay, where they are
        # State of the checks
        self.outside_m = 0.0  # from the ego's centre to the nearest lane, 0 inside
        self.outside_distance_m = 0.0  # driven while that exceeded `TOLERANCE_M`
        self.lateral_m, self._furthest_m = 0.0, 0.0
        self._was_outside = False
        self._met = set[tuple[int, int]]()
        # Why the world has ended by itself, at the goal or by a collision. A runner may
        # stop earlier for other reasons.
        self.reason: Ending | None = None
        self.collided: dict[int, Scene] = {}  # at the ego's collisions, by time_us
        # Right of way decides at the ego's signs
        meets = min((begin for begin, _ in rules.priority_over_ego()), default=math.inf)
        for sign in stage.regulators:
            if sign.kind is SignalKind.GIVE_WAY and sign.line_s is not None:
                sign.nearest_s, sign.conflict_s = rules.soonest_s, meets
        stage.schedule.show(0)
        self._take_stage()
        self._road.refresh()

    @property
    def time_us(self) -> int:
        """Simulated time since the start."""
        return self.stage.time_us

    @property
    def done(self) -> bool:
        """Whether the world has ended by itself."""
        return self.reason is not None

    @property
    def events(self) -> tuple[Event, ...]:
        """All events so far, in order."""
        return tuple(self.stage.events)

    @property
    def ego_s(self) -> float:
        """Arc length of the ego's projection on its route."""
        return self.stage.ego_s

    @property
    def progress_m(self) -> float:
        """The largest arc length reached, at most the goal's."""
        return min(self._furthest_m, self.path.goal_m)

    def scene(self) -> Scene:
        """Return a frozen snapshot, right-handed."""
        stage = self.stage
        self._still += map(_actor, stage.static_objects[len(self._still) :])
        actors = (*map(_actor, stage.bodies), *self._still)
        signals = tuple(signal.snapshot() for signal in stage.regulators)
        return Scene(self.time_us, stage.ego.snapshot(), actors, signals)

    def step(self, control: Control) -> None:
        """Advance by one frame.

        Raises:
            EvaluationError: The control is not finite, or the world has ended.
        """
        wanted = (control.acceleration_mps2, control.steering_rad)
        if not all(math.isfinite(value) for value in wanted):
            raise EvaluationError(f"route {self.route.id}: {control} is not finite")
        if self.done:
            raise EvaluationError(f"route {self.route.id} has ended: {self.reason}")
        stage = self.stage
        stage.ego.wanted = control
        # every 0.1 s: scripts act, then cars decide on the same positions
        if stage.time_us >= self._next_decision_us:
            self._next_decision_us += DECISION_US
            stage.scripts = [s for s in stage.scripts if next(s, stage) is not stage]
            here = [stage.ego, *stage.bodies, *stage.static_objects]
            stage.bodies += stage.schedule.due(stage.time_us, here)
            self._take_stage()
            self._road.ego_s = stage.ego_s
            self._road.act()
        # every frame: bodies move, then the rules are checked
        self._road.step(self.dt_us / 1e6)
        stage.time_us += self.dt_us
        stage.schedule.show(stage.time_us)
        pose = stage.ego.pose
        stage.ego_s, self.lateral_m = self.path.project(pose.x, pose.y, stage.ego_s)
        self._furthest_m = max(self._furthest_m, stage.ego_s)
        self._check_lanes()
        half = stage.ego.LENGTH / 2
        for sign in stage.regulators:
            front, tail = stage.ego_s + half, stage.ego_s - half
            kind = sign.check(front, tail, stage.ego.speed)
            if kind is not None:
                stage.events.append(stage.event(kind, f"signal {sign.id}"))
        self._check_collisions()
        if not self.done and self._furthest_m >= self.path.goal_m:
            self.reason = Ending.COMPLETED
            at_goal = (judge() for judge in stage.at_goal)
            stage.events += [event for event in at_goal if event is not None]

    def _take_stage(self) -> None:
        """Take over the bodies that scripts added and removed; drop cars that left."""
        stage = self.stage
        stage.bodies = [
            body for body in stage.bodies if not (isinstance(body, Car) and body.gone)
        ]
        self._road.vehicles = [stage.ego, *stage.bodies]
        self._road.objects = list(stage.static_objects)
        for body in stage.bodies:
            body.road = self._road

    def _check_lanes(self) -> None:
        stage, pose = self.stage, self.stage.ego.pose
        self.outside_m = self.roadmap.outside_m(pose.x, pose.y)
        outside = self.outside_m > TOLERANCE_M
        if outside:
            self.outside_distance_m += stage.ego.speed * self.dt_us / 1e6
            if not self._was_outside:
                words = f"{self.outside_m:.2f} m outside every lane"
                stage.events.append(stage.event(EventKind.OUTSIDE_LANES, words))
        self._was_outside = outside

    def _check_collisions(self) -> None:
        for a, b in self._road.touching():
            if (a.id, b.id) in self._met:
                continue
            self._met.add((a.id, b.id))
            if a.id == 0 and a.speed < STANDING_MPS:
                event = self.stage.event(EventKind.STRUCK, "the standing ego", b)
            elif a.id == 0:
                event = self.stage.event(EventKind.COLLISION, "the ego", b)
                self.collided.setdefault(self.time_us, self.scene())
                self.reason = Ending.COLLISION
            else:
                words = f"actor {a.id}"
                event = self.stage.event(EventKind.ACTOR_COLLISION, words, b)
            self.stage.events.append(event)


def _actor(body: Car | Walker | StaticObject) -> Actor:
    x, y = body.position.tolist()
    motion = x, -y, -float(body.heading), float(body.speed)
    size = float(body.LENGTH), float(body.WIDTH), float(body.height)
    return Actor(body.id, body.kind, *motion, *size, bool(body.braking), body.indicator)
