"""Cars before the ego: braking, pulling out, cutting in, crawling."""

from collections.abc import Sequence

from me2e_compress.simulator.scenarios.layouts.crossings import Crossing
from me2e_compress.simulator.scenarios.layouts.ramps import Ramp
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    Traffic,
    encounter,
    hold,
    keep_clear,
    near,
    release,
    stand,
    stream,
)
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Pose,
)
from me2e_compress.simulator.traffic.stage import Script, Stage

AWAY_MPS = 10.0


def hard_brake(stage: Stage, street: Street) -> Script:
    """Brake the car ahead to a stop, where it stands for a while."""
    gap = stage.uniform("gap_m", 13.0, 18.0)
    where = stage.place("brake_m", 35.0, 60.0)
    hardest = stage.uniform("brake_mps2", 5.0, 7.0)
    speed = float(stage.ego.speed)
    car = stage.car(street.ahead(), BEFORE_M + gap + 5.0, speed)
    keep_clear(stage, street.ahead(), where + 30.0)
    yield from _brake_at(stage, car, where, hardest)


def _brake_at(stage: Stage, car: Car, route_s: float, hardest: float) -> Script:
    """Brake a car that drives by IDM, once the ego passes a place, for a while."""
    stands = stage.uniform("stands_s", 2.0, 6.0)
    car.target_speed = stage.uniform("lead_mps", 8.0, 10.0)
    yield from near(stage, route_s)
    stage.fire("hard_brake", car)
    car.forced_mps2 = -hardest
    yield from hold(stage, car.speed / hardest + stands)
    release(car, AWAY_MPS)


def pull_out(stage: Stage, street: Street) -> Script:
    """Move a parked car out in front of the ego, at a crawl."""
    s = stage.place("pull_out_m", 55.0, 75.0)
    _draw_crawl(stage)
    for aside in (-13.0, -6.5, 14.0, 20.5):
        _park(stage, s + aside)
    car = stage.car(street.shoulder(), BEFORE_M + s, 0.0)
    stand(car)
    yield from near(stage, s - 2.0)
    yield from _cut_in(stage, car, street.ahead(), 1, "pull_out", 2.2)


def queue_cut_in(stage: Stage, street: Street) -> Script:
    """Move a car out of a standing queue in the next lane."""
    s = stage.place("cut_in_m", 55.0, 75.0)
    _draw_crawl(stage)
    lane = street.other_lane()
    chain = street.ahead(lane)
    # a standing queue with room ahead of the car that leaves it
    for index in (lane, street.lane):
        keep_clear(stage, street.ahead(index), s)
    cutter: Car | None = None
    for aside in (-14.0, -7.0, 0.0, 11.0, 18.0):
        car = stage.car(chain, BEFORE_M + s + aside, 0.0)
        stand(car)
        cutter = car if aside == 0.0 else cutter
    # leave when the ego is near
    yield from near(stage, s - 2.0)
    if cutter is not None:
        side = 1 if street.lane < lane else -1
        yield from _cut_in(stage, cutter, street.ahead(), side, "queue_cut_in", 2.2)


def ramp_cut_in(stage: Stage, ramp: Ramp) -> Script:
    """Merge slow cars from the on-ramp into the ego's lane."""
    gap = stage.uniform("ramp_gap_s", 3.0, 5.5)
    slow = stage.uniform("ramp_mps", 5, 8)
    joins = tuple(ramp.main.ahead())
    traffic = Traffic(gap, (slow, slow + 1.0), joins=joins, blind_to_ego=0.5)
    cars = stream(stage, "ramp_cut_in", [ramp.ramp], traffic)
    joint = stage.network.pose(ramp.ramp[-1], 30.0)
    s, _ = stage.path.project(joint.x, joint.y)
    yield from encounter(stage, cars, s, "ramp_cut_in")


def slow_queue(stage: Stage, ramp: Ramp) -> Script:
    """Drive dense, slow traffic where the ego must enter; at some time it speeds up."""
    slow = stage.uniform("slow_mps", 3.0, 4.5)
    gap = stage.uniform("slow_gap_s", 3.4, 4.6)
    until = stage.uniform("slow_until_s", 25.0, 50.0)
    traffic = Traffic(gap, (slow, slow + 0.5), platoons=0.1)
    cars = stream(stage, "slow_queue", [ramp.main.ahead()], traffic)
    stage.play(_speed_up(stage, cars, until))
    yield from encounter(stage, cars, ramp.merge_s, "slow_queue")


def _speed_up(stage: Stage, cars: Sequence[Car], until_s: float) -> Script:
    """Let cars drive faster from a time on."""
    yield from hold(stage, until_s)
    for car in cars:
        car.target_speed += 5.0


def queue_at_light(stage: Stage, crossing: Crossing) -> Script:
    """Put a queue ahead of the ego that the light holds until it turns green."""
    line = crossing.signals["back"].line_s or crossing.approach_m
    count = stage.integer("queue", 1, 3)
    chain = crossing.way("back", crossing.move)
    begin = stage.network.length(chain[0]) - crossing.approach_m
    queue = [
        stage.car(chain, begin + line - 3.5 - 7.0 * k, 0.0, AWAY_MPS)
        for k in range(count)
    ]
    tail = line - 3.5 - 7.0 * (count - 1) - 2.5
    while stage.ahead_m(tail) > 35.0:
        yield
    stage.fire("queue_at_light", queue[-1])


def blocked_exit(stage: Stage, crossing: Crossing) -> Script:
    """Block the ego's way out of the junction with a truck, for some time."""
    chain = crossing.way("back", crossing.move)
    into = stage.uniform("into_m", 1.0, 5.0)
    truck = stage.car(chain[2:], into + 2.0, 0.0, kind=ActorKind.TRUCK)
    stand(truck)
    stage.play(_leave(stage, truck, stage.uniform("leaves_s", 18.0, 40.0)))
    pose = truck.pose
    s, _ = stage.path.project(pose.x, pose.y)
    while stage.ahead_m(s) > 40.0:
        yield
    stage.fire("blocked_exit", truck)


def _leave(stage: Stage, car: Car, at_s: float) -> Script:
    """Let a standing car drive off at a time."""
    yield from hold(stage, at_s)
    release(car, AWAY_MPS)


def _draw_crawl(stage: Stage) -> None:
    """Draw how long a car crawls after it has cut in."""
    stage.uniform("crawl_s", 4.0, 9.0)


def _cut_in(
    stage: Stage, car: Car, lanes: list[LaneIndex], side: int, name: str, crawl: float
) -> Script:
    """Move into the ego's lane, crawl there, drive off."""
    crawl_s = float(stage.parameters["crawl_s"])
    stage.fire(name, car)
    # change lanes at a crawl
    target, _ = stage.network.rest(lanes, _s_along(stage, lanes, car.pose))
    car.change_lane(target, side)
    release(car, crawl)
    until = stage.time_s + crawl_s
    while stage.time_s < until:
        yield
        if car.speed > crawl + 1.0:
            car.forced_mps2 = -5.0
        else:
            car.forced_mps2 = None
    car.indicator = 0
    release(car, AWAY_MPS)


def _s_along(stage: Stage, lanes: list[LaneIndex], pose: Pose) -> float:
    """Return the arc length nearest to a pose on the first lane of a chain."""
    lane = stage.network.lane(lanes[0])
    return float(lane.local_coordinates([pose.x, -pose.y])[0])


def _park(stage: Stage, s_m: float) -> None:
    """Park a car in the lane beside the route's."""
    side = -(LANE_WIDTH_M / 2 + 1.25)
    stage.static_object(ActorKind.PARKED, stage.route_pose(s_m, side))
