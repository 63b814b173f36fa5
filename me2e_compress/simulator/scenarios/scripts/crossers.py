"""Pedestrians and cyclists who cross the ego's way."""

from dataclasses import dataclass

import numpy as np

from me2e_compress.simulator.scenarios.layouts.crossings import Crossing
from me2e_compress.simulator.scenarios.layouts.road import Street
from me2e_compress.simulator.scenarios.scripts.streams import encounter, steps_out
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.bodies import Walker
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M
from me2e_compress.simulator.traffic.stage import HORIZON_S, Script, Stage

HALF_LANE_M = LANE_WIDTH_M / 2


def walker_behind_van(stage: Stage, _: Street) -> Script:
    """Send a pedestrian out from behind a van that stands at the kerb."""
    s = stage.place("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.5, 2.5)
    van = stage.route_pose(s - 5.0, -(HALF_LANE_M + 1.1))
    stage.static_object(ActorKind.VAN, van)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.2), 6.5)
    yield from steps_out(stage, walker, s)
    stage.fire("walker_behind_van", walker)


def walker_between_cars(stage: Stage, _: Street) -> Script:
    """Send a pedestrian out between two parked cars."""
    s = stage.place("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.4, 2.2)
    for aside in (-16.5, -10.0, -3.3, 3.3, 9.9):
        pose = stage.route_pose(s + aside, -(HALF_LANE_M + 1.3))
        stage.static_object(ActorKind.PARKED, pose)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.4), 7.0)
    yield from steps_out(stage, walker, s)
    stage.fire("walker_between_cars", walker)


def walkers_on_zebra(stage: Stage, _: Street) -> Script:
    """Let people cross at the light, from both sides."""
    s = float(stage.parameters["crosswalk_m"])
    yield from encounter(stage, walkers_at_light(stage), s, "walkers_on_zebra")


WALKERS_A_CYCLE = 2.0
"""Mean number of people who cross at a light, each time it lets them."""
LATE = 0.2
"""Share of them who cross at any time of their phase, even as it ends."""


def walkers_at_light(stage: Stage) -> list[Walker]:
    """Draw people who cross while a light holds back the traffic."""
    random, schedule = stage.random("at_light"), stage.schedule
    s, found = float(stage.parameters["light_m"]), list[Walker]()
    plan, across = schedule.plans[-1], stage.light_across_m
    start = plan.begins_s(1)
    while start < HORIZON_S:
        for _ in range(int(random.poisson(WALKERS_A_CYCLE))):
            late = random.random() < LATE
            at = start + random.uniform(0.0, plan.green_s[1] if late else 2.0)
            ends = across if random.random() < 0.5 else across[::-1]
            aside = s + random.uniform(-1.2, 1.2)
            speed = float(random.uniform(1.2, 1.8))
            walker = _across_route(stage, aside, speed, *ends)
            stage.bodies.remove(walker)
            walker.going = walker.crosses = True
            schedule.add(float(at), walker)
            found.append(walker)
        start += plan.cycle_s
    return found


def pedestrians_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """Send three pedestrians across the arm that the ego turns into."""
    speed = stage.uniform("walk_mps", 1.3, 2.0)
    row = _row(stage, crossing, ActorKind.PEDESTRIAN, speed, LANE_WIDTH_M + 1.5, 3, 1.3)
    yield from _set_off(stage, row, "pedestrians_on_exit")


def cyclists_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """Send three cyclists across the arm that the ego turns into."""
    speed = stage.uniform("ride_mps", 2.8, 4.0)
    row = _row(stage, crossing, ActorKind.BICYCLE, speed, LANE_WIDTH_M + 4.0, 3, 2.4)
    yield from _set_off(stage, row, "cyclists_on_exit")


def bicycle_stream(stage: Stage, crossing: Crossing) -> Script:
    """Send a long row of cyclists across the arm that the ego turns into."""
    speed = stage.uniform("ride_mps", 3.0, 4.0)
    count = stage.integer("cyclists", 4, 7)
    spacing = stage.uniform("spacing_m", 2.6, 3.6)
    start = LANE_WIDTH_M + 4.0
    row = _row(stage, crossing, ActorKind.BICYCLE, speed, start, count, spacing)
    yield from _set_off(stage, row, "bicycle_stream")


@dataclass(frozen=True)
class Row:
    """People behind each other, the first one first.

    ``route_s`` is the arc length of the route where they cross it.
    """

    people: list[Walker]
    route_s: float


def _row(
    stage: Stage,
    crossing: Crossing,
    kind: ActorKind,
    speed: float,
    start_m: float,
    count: int,
    spacing_m: float,
) -> Row:
    """Place people who cross the arm that the ego leaves by, from a random side."""
    side = -1.0 if stage.choice("side", ("right", "left")) == "right" else 1.0
    out_m = 2.0 if kind is ActorKind.PEDESTRIAN else 3.0
    target = crossing.arm(crossing.move, out_m, -HALF_LANE_M)
    s, _ = stage.path.project(target.x, target.y)
    row = Row([], s)
    for k in range(count):
        start = start_m + spacing_m * k
        end = LANE_WIDTH_M + 3.0 + spacing_m * (count - k)
        begin = crossing.arm(crossing.move, out_m, side * start)
        stop = crossing.arm(crossing.move, out_m, -side * end)
        line = np.array([[begin.x, begin.y], [stop.x, stop.y]])
        row.people.append(stage.walker(kind, line, speed))
    return row


def _set_off(stage: Stage, row: Row, name: str) -> Script:
    """Send a row off; the second of them counts."""
    who = row.people[1]
    yield from steps_out(stage, who, row.route_s)
    for walker in row.people:
        walker.going = True
    stage.fire(name, who)


def _across_route(
    stage: Stage, s_m: float, speed: float, from_m: float, to_m: float
) -> Walker:
    """Place a pedestrian who crosses the route at a right angle; offsets are left."""
    begin, end = stage.route_pose(s_m, from_m), stage.route_pose(s_m, to_m)
    line = np.array([[begin.x, begin.y], [end.x, end.y]])
    return stage.walker(ActorKind.PEDESTRIAN, line, speed)
