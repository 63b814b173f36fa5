"""People on foot and on bicycles who cross the ego's way."""

import numpy as np

from me2e_compress.evaluators.highway.scenarios.layouts.crossings import Crossing
from me2e_compress.evaluators.highway.scenarios.scripts.timing import steps_out
from me2e_compress.evaluators.highway.scene import ActorKind
from me2e_compress.evaluators.highway.traffic.bodies import Walker
from me2e_compress.evaluators.highway.traffic.network import LANE_WIDTH_M, Pose
from me2e_compress.evaluators.highway.traffic.stage import Script, Stage

HALF_LANE_M = LANE_WIDTH_M / 2


def walker_behind_van(stage: Stage) -> Script:
    """A pedestrian walks out from behind a van that stands at the kerb."""
    s = stage.uniform("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.5, 2.5)
    van = stage.route_pose(s - 5.0, -(HALF_LANE_M + 1.1))
    stage.thing(ActorKind.VAN, van)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.2), 6.5)
    yield from steps_out(stage, walker, s, HALF_LANE_M + 2.2)
    stage.fire("walker_behind_van", walker)


def walker_between_cars(stage: Stage) -> Script:
    """A pedestrian steps out between two parked cars."""
    s = stage.uniform("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.4, 2.2)
    for aside in (-16.5, -10.0, -3.3, 3.3, 9.9):
        pose = stage.route_pose(s + aside, -(HALF_LANE_M + 1.3))
        stage.thing(ActorKind.PARKED, pose)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.4), 7.0)
    yield from steps_out(stage, walker, s, HALF_LANE_M + 2.4)
    stage.fire("walker_between_cars", walker)


def walkers_on_zebra(stage: Stage) -> Script:
    """Two to four people cross at the crosswalk from both sides."""
    s = float(stage.parameters["crosswalk_m"])
    count = stage.integer("walkers", 2, 4)
    walkers = list[Walker]()
    for k in range(count):
        speed = stage.uniform(f"walk_{k}_mps", 1.2, 1.7)
        near = k % 2 == 0
        start = -(HALF_LANE_M + 1.6) if near else HALF_LANE_M + LANE_WIDTH_M + 1.2
        end = HALF_LANE_M + LANE_WIDTH_M + 2.0 if near else -(HALF_LANE_M + 2.0)
        walkers.append(_across_route(stage, s + 0.7 * (k - 1), speed, start, end))
    yield from steps_out(stage, walkers[0], s, HALF_LANE_M + 1.6)
    for walker in walkers:
        walker.going = True
    stage.fire("walkers_on_zebra", walkers[0])


def pedestrian_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """While the ego turns, a pedestrian crosses the arm that it turns into."""
    speed = stage.uniform("walk_mps", 1.3, 2.0)
    walker, reach, s = _across_arm(
        stage, crossing, ActorKind.PEDESTRIAN, speed, 2.0, LANE_WIDTH_M + 1.5
    )
    yield from steps_out(stage, walker, s, reach)
    stage.fire("pedestrian_on_exit", walker)


def cyclist_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """While the ego turns, a cyclist crosses the arm that it turns into."""
    speed = stage.uniform("ride_mps", 2.8, 4.0)
    walker, reach, s = _across_arm(
        stage, crossing, ActorKind.BICYCLE, speed, 2.5, LANE_WIDTH_M + 5.5
    )
    yield from steps_out(stage, walker, s, reach)
    stage.fire("cyclist_on_exit", walker)


def bicycle_stream(stage: Stage, crossing: Crossing) -> Script:
    """A row of cyclists crosses the arm that the ego turns into."""
    speed = stage.uniform("ride_mps", 3.0, 4.0)
    count = stage.integer("cyclists", 3, 5)
    spacing = stage.uniform("spacing_m", 3.5, 5.0)
    riders = list[Walker]()
    reach = s = 0.0
    for k in range(count):
        start = LANE_WIDTH_M + 5.0 + spacing * k
        rider, far, at = _across_arm(
            stage, crossing, ActorKind.BICYCLE, speed, 3.0, start
        )
        riders.append(rider)
        if k == 0:
            reach, s = far, at
    yield from steps_out(stage, riders[0], s, reach)
    for rider in riders:
        rider.going = True
    stage.fire("bicycle_stream", riders[0])


def _across_route(
    stage: Stage, s_m: float, speed: float, from_m: float, to_m: float
) -> Walker:
    """Somebody who crosses the route at a right angle, offsets to the left."""
    begin, end = stage.route_pose(s_m, from_m), stage.route_pose(s_m, to_m)
    line = np.array([[begin.x, begin.y], [end.x, end.y]])
    return stage.walker(ActorKind.PEDESTRIAN, line, speed)


def _across_arm(
    stage: Stage,
    crossing: Crossing,
    kind: ActorKind,
    speed: float,
    out_m: float,
    start_m: float,
) -> tuple[Walker, float, float]:
    """Somebody who crosses the arm that the ego leaves by.

    Returns:
        Who, how far it is to the ego's lane, and where that is on the route.
    """
    side = -1.0 if stage.choice("side", ("right", "left")) == "right" else 1.0
    end_m = -(LANE_WIDTH_M + 3.0)
    begin = crossing.arm(crossing.move, out_m, side * start_m)
    end = crossing.arm(crossing.move, out_m, side * end_m)
    target: Pose = crossing.arm(crossing.move, out_m, -HALF_LANE_M)
    s, _ = stage.path.project(target.x, target.y)
    line = np.array([[begin.x, begin.y], [end.x, end.y]])
    reach = start_m - HALF_LANE_M if side < 0 else start_m + HALF_LANE_M
    return stage.walker(kind, line, speed), reach, s
