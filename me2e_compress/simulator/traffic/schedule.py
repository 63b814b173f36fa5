"""What is drawn before a route begins: arrivals and signals.

Nothing here looks at the ego, except that who would appear on top of somebody stays
away.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from me2e_compress.simulator.traffic.bodies import EgoVehicle, StaticObject, Walker
from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.network import LaneIndex
from me2e_compress.simulator.traffic.signals import Regulator, SignalPlan

Body = Car | Walker | StaticObject | EgoVehicle
HORIZON_S = 200.0
"""Arrivals are drawn for as long as a route may last (the leaderboard's 4000 ticks)."""
SHORTEST_S = 1.6
"""Two cars of one lane do not arrive closer to each other."""
PLATOON_S = (1.6, 2.6)
PLATOON = 4
"""Most followers in a platoon."""


@dataclass(frozen=True, slots=True)
class Arrival:
    """A body and when it appears."""

    time_us: int
    body: Car | Walker


@dataclass
class Schedule:
    """Arrivals and signal plans of one route.

    Attributes:
        claimed: Lanes into the map whose traffic a script has drawn.
        lines: Lights by the lane that they stop, with the arc length of the line.
        arrivals: In order of time, once closed.
    """

    plans: list[SignalPlan] = field(default_factory=list)
    claimed: list[LaneIndex] = field(default_factory=list)
    lines: dict[LaneIndex, list[tuple[float, Regulator]]] = field(default_factory=dict)
    arrivals: list[Arrival] = field(default_factory=list)
    _next: int = 0

    def add(self, time_s: float, body: Car | Walker) -> None:
        """Let a body appear at a time."""
        self.arrivals.append(Arrival(round(time_s * 1e6), body))

    def close(self) -> None:
        """Put the arrivals in order; none is added afterwards."""
        self.arrivals.sort(key=lambda each: (each.time_us, each.body.id))

    def show(self, time_us: int) -> None:
        """Set all lights."""
        for plan in self.plans:
            plan.show(time_us)

    def due(self, time_us: int, present: Sequence[Body]) -> list[Car | Walker]:
        """Return who appears now; who finds the place taken stays away for good."""
        found = list[Car | Walker]()
        while self._next < len(self.arrivals):
            arrival = self.arrivals[self._next]
            if arrival.time_us > time_us:
                break
            self._next += 1
            if is_free(arrival.body, [*present, *found]):
                found.append(arrival.body)
        return found


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
    """Draw arrivals of one lane from ``begin_s`` to `HORIZON_S`.

    Gaps are exponential beyond the shortest; with the probability ``platoons`` a car
    leads a platoon. The mean gap is the same either way.
    """
    at, found = begin_s + float(random.uniform(0.0, mean_s)), list[float]()
    while at < HORIZON_S:
        found.append(at)
        followers = 0
        if random.random() < platoons:
            followers = int(random.integers(1, PLATOON))
        for _ in range(followers):
            at += float(random.uniform(*PLATOON_S))
            found.append(at)
        rest = mean_s * (1 + followers) - followers * sum(PLATOON_S) / 2 - SHORTEST_S
        at += SHORTEST_S + float(random.exponential(max(rest, 0.5)))
    return found
