"""The setup of a scenario, and what its scripts see while it runs.

Arrivals and signals are drawn before a route begins. Nothing looks at the ego, except
that who would appear on top of somebody stays away.
"""

import itertools
import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field

import numpy as np
from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.camera_rig import DRAWN, drawn_weather
from me2e_compress.simulator.plane_geometry import Floats, Point, RoutePath
from me2e_compress.simulator.routes import Parameter, Route
from me2e_compress.simulator.scene import ActorKind, Event, EventKind, SignalKind, Size
from me2e_compress.simulator.traffic.bodies import (
    Behaviour,
    Car,
    EgoVehicle,
    StaticObject,
    Walker,
)
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Leg,
    Network,
    Pose,
    build_path,
)
from me2e_compress.simulator.traffic.right_of_way import Regulator, SignalPlan

Body = Car | Walker | StaticObject | EgoVehicle
HORIZON_S = 200.0  # a route may last so long (the leaderboard's 4000 ticks)
SHORTEST_S = 1.6  # two cars of one lane do not arrive closer to each other
PLATOON_S = (1.6, 2.6)
PLATOON = 4  # most followers in a platoon
Script = Iterator[None]  # of an actor, resumed at every decision
GOAL_M = 150.0  # length of a route without what is drawn before and after
LEAD_M, AFTER_M = (25.0, 60.0), (25.0, 190.0)  # around a scenario's places
TRAFFIC = "traffic"  # the parameter that, with the seed, decides all arrivals


@dataclass
class Schedule:
    """Arrivals and signal plans of one route."""

    plans: list[SignalPlan] = field(default_factory=list)
    # Lanes whose traffic a script has drawn
    claimed: list[LaneIndex] = field(default_factory=list)
    # Lights by the lane that they stop, with the arc length of the line
    lines: dict[LaneIndex, list[tuple[float, Regulator]]] = field(default_factory=dict)
    # Bodies with their time_us of arrival, in order of time once the stage is set
    arrivals: list[tuple[int, Car | Walker]] = field(default_factory=list)
    _next: int = 0

    def add(self, time_s: float, body: Car | Walker) -> None:
        """Let a body appear at a time."""
        self.arrivals.append((round(time_s * 1e6), body))

    def show(self, time_us: int) -> None:
        """Set all lights."""
        for plan in self.plans:
            plan.show(time_us)

    def due(self, time_us: int, present: Sequence[Body]) -> list[Car | Walker]:
        """Return who appears now; who finds the place taken stays away for good."""
        arrivals = list[Car | Walker]()
        for arrives_us, body in self.arrivals[self._next :]:
            if arrives_us > time_us:
                break
            self._next += 1
            if is_free(body, [*present, *arrivals]):
                arrivals.append(body)
        return arrivals


def is_free(body: Body, present: Sequence[Body], room_m: float = 2.0) -> bool:
    """Return whether a body has room where it is: bumper to bumper, and to react."""
    x, y = body.position
    if isinstance(body, Car):
        room_m += 0.8 * float(body.speed)
    for other in present:
        ox, oy = other.position
        needed = (body.LENGTH + other.LENGTH) / 2 + room_m
        if isinstance(body, Walker):
            needed = 1.5
        if math.hypot(ox - x, oy - y) < needed:
            return False
    return True


def arrival_times(
    random: np.random.Generator, mean_s: float, begin_s: float, platoons: float
) -> list[float]:
    """Draw arrival times (s) of one lane, ``mean_s`` apart, until `HORIZON_S`."""
    # Gaps are exponential beyond the shortest; with the probability `platoons` a car
    # leads a platoon. The mean gap is the same either way.
    at, times = begin_s + float(random.uniform(0.0, mean_s)), list[float]()
    while at < HORIZON_S:
        times.append(at)
        followers = 0
        if random.random() < platoons:
            followers = int(random.integers(1, PLATOON))
        for _ in range(followers):
            at += float(random.uniform(*PLATOON_S))
            times.append(at)
        rest = mean_s * (1 + followers) - followers * sum(PLATOON_S) / 2 - SHORTEST_S
        at += SHORTEST_S + float(random.exponential(max(rest, 0.5)))
    return times


class Stage:
    """Everything a scenario is made of.

    Layouts lay out the network and the route, scripts put actors on it; both do so
    before the first frame. Afterwards scripts are resumed at every decision.
    """

    def __init__(self, route: Route) -> None:
        self.route = route
        self.parameters: dict[str, Parameter] = {}
        # set by layouts and scripts
        self.path: RoutePath
        self.ego: EgoVehicle
        self.network = Network()
        self.scripts: list[Script] = []
        self.bodies: list[Car | Walker] = []
        self.static_objects: list[StaticObject] = []
        self.regulators: list[Regulator] = []
        self.crosswalks: list[tuple[Point, Point, Point, Point]] = []
        self.at_goal: list[Callable[[], Event | None]] = []
        self.events: list[Event] = []
        # set by the world, frame by frame
        self.time_us = 0
        self.ego_s = 0.0
        self._ids = itertools.count(1)  # the ego has 0
        # traffic and weather
        self.ego_lanes: list[tuple[LaneIndex, float]] = []
        # Lanes into the map on which nobody begins between two stations
        self.clear: dict[LaneIndex, tuple[float, float]] = {}
        self.schedule = Schedule()
        self.light_across_m = (0.0, 0.0)  # ends of a crossing, left of the route
        self.lead_m: float = self.uniform("lead_m", *LEAD_M)
        low, high = AFTER_M
        spread = self.uniform("after_share", 0.0, 1.0)
        after_m = round(low + (high - low) * spread**4, 3)
        self.goal_m = GOAL_M + (self.lead_m + after_m)
        self._traffic = self.integer(TRAFFIC, 0, 2**31 - 1)
        kind, strength = self.choice("weather", DRAWN), 0.0
        if kind != "clear":
            strength = self.uniform("weather_strength", 0.2, 1.0)
        self.weather = drawn_weather(kind, strength, route.seed % 2**31)

    def place(self, name: str, low: float, high: float) -> float:
        """Draw an arc length of the route, after the metres that come before."""
        return self.uniform(name, low + self.lead_m, high + self.lead_m)

    def random(self, name: str) -> np.random.Generator:
        """Return a generator of traffic: another ``traffic`` gives other numbers."""
        key = [self.route.seed, self._traffic, zlib.crc32(name.encode())]
        return np.random.default_rng(key)

    def uniform(self, name: str, low: float, high: float) -> float:
        """Draw a parameter between two bounds, to the millimetre."""
        drawn = round(float(self._random(name).uniform(low, high)), 3)
        return float(self._set(name, drawn))

    def integer(self, name: str, low: int, high: int) -> int:
        """Draw an integer parameter between two bounds, both included."""
        return int(self._set(name, int(self._random(name).integers(low, high + 1))))

    def choice(self, name: str, options: Sequence[str]) -> str:
        """Draw one of several words."""
        drawn = options[int(self._random(name).integers(len(options)))]
        return str(self._set(name, drawn))

    def _set(self, name: str, drawn: Parameter) -> Parameter:
        # A value depends on the route's seed and the name alone; the manifest's wins
        value = self.route.parameters.get(name, drawn)
        self.parameters[name] = value
        return value

    def _random(self, name: str) -> np.random.Generator:
        return np.random.default_rng([self.route.seed, zlib.crc32(name.encode())])

    @property
    def time_s(self) -> float:
        """Seconds since the route began."""
        return self.time_us / 1e6

    @property
    def more_m(self) -> float:
        """Metres of the route that are drawn, before and after the scenario."""
        return self.goal_m - GOAL_M

    def play_script(self, script: Script) -> None:
        """Add a script and run it to its first yield, so that its actors are there."""
        if next(script, self) is not self:
            self.scripts.append(script)

    def set_route(self, legs: Sequence[Leg], speed_mps: float) -> None:
        """Set the ego's route and put the ego at its beginning."""
        self.path = build_path(self.network, legs, self.goal_m)
        for leg in legs:
            if leg.lane in self.network.ranks:
                x, y = self.network.centre(leg.lane)[0]
                begin, _ = self.path.project(float(x), float(y))
                self.ego_lanes.append((leg.lane, begin))
        (x, y), heading = self.path.points[0], self.path.headings[0]
        self.ego = EgoVehicle(Pose(float(x), float(y), float(heading)), speed_mps)

    def add_car(
        self,
        chain: Sequence[LaneIndex],
        s_m: float,
        speed_mps: float,
        target_mps: float | None = None,
        kind: ActorKind = ActorKind.CAR,
        behaviour: Behaviour | None = None,
        comes: bool = False,
    ) -> Car:
        """Make a car on a chain of lanes, at an arc length; if it ``comes``, later."""
        number, (lanes, s_m) = next(self._ids), self.network.rest(chain, s_m)
        car = Car(
            number, self.network, lanes, s_m, speed_mps, target_mps, kind, behaviour
        )
        if not comes:
            self.bodies.append(car)
        return car

    def add_walker(self, kind: ActorKind, line: Floats, speed_mps: float) -> Walker:
        """Put a walker at the beginning of a line; `going` starts it."""
        walker = Walker(next(self._ids), kind, line, speed_mps)
        self.bodies.append(walker)
        return walker

    def add_object(
        self, kind: ActorKind, pose: Pose, size: Size | None = None
    ) -> StaticObject:
        """Put a static object somewhere."""
        placed = StaticObject(next(self._ids), kind, pose, size)
        self.static_objects.append(placed)
        return placed

    def add_regulator(
        self, kind: SignalKind, line: Pose, width_m: float = LANE_WIDTH_M
    ) -> Regulator:
        """Put a light or a sign at a stop line, given by its middle and width."""
        s, lateral = self.path.project(line.x, line.y)
        way = math.cos(float(self.path.value(self.path.headings, s)) - line.heading)
        on_route = abs(lateral) < width_m / 2 and way > 0.5
        number = len(self.regulators) + 1
        line_s = s if on_route else None
        regulator = Regulator(number, kind, line, line_s, width_m=width_m)
        self.regulators.append(regulator)
        return regulator

    def add_crosswalk(self, corners: Sequence[Pose]) -> None:
        """Paint a crosswalk between four corners."""
        a, b, c, d = ((corner.x, corner.y) for corner in corners)
        self.crosswalks.append((a, b, c, d))

    def route_pose(self, s_m: float, left_m: float = 0.0) -> Pose:
        """Return a pose beside the route."""
        x, y, heading = self.path.at(s_m, left_m)
        return Pose(float(x), float(y), float(heading))

    def ahead_m(self, s_m: float) -> float:
        """Return the metres of route from the ego's centre to an arc length."""
        return s_m - self.ego_s

    def gap_m(self, car: Car) -> float:
        """Return the metres of route between the bumpers of the ego and a car ahead."""
        pose = car.pose
        s, _ = self.path.project(pose.x, pose.y)
        return float(s - self.ego_s - (self.ego.LENGTH + car.LENGTH) / 2)

    def record_trigger(self, script: str, body: RoadObject | None = None) -> None:
        """Record that a script's event happens now."""
        self.events.append(self.event(EventKind.TRIGGER, script, body))

    def event(
        self, kind: EventKind, detail: str, body: RoadObject | None = None
    ) -> Event:
        """Return an event here and now."""
        pose = self.ego.pose
        other = (None, None) if body is None else (body.id, body.kind)
        speed = float(self.ego.speed)
        return Event(self.time_us, kind, detail, pose.x, pose.y, speed, *other)
