"""Things in the way: accidents, road works, parked cars, doors, slow cyclists."""

from typing import NamedTuple

import numpy as np

from me2e_compress.simulator.scenarios import flows
from me2e_compress.simulator.scenarios.crossings import Crossing
from me2e_compress.simulator.scenarios.roads import BEFORE_M, Ramp, Street
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.bodies import Behaviour, Car, Walker
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M, LaneIndex
from me2e_compress.simulator.traffic.stage import HORIZON_S, Script, Stage

TOGETHER = Behaviour(headway_s=0.4, jam_gap_m=1.5)  # cyclists stay a short row
ONCOMING_S = (16.0, 24.0)  # mean gap of the oncoming traffic where one must overtake
AWAY_MPS = 10.0
CRAWL_MPS, CRAWL_S = 2.2, (4.0, 9.0)  # of a car that has cut in
HALF_LANE_M = LANE_WIDTH_M / 2
WALKERS_A_CYCLE = 2.0  # mean number of people each time a light lets them cross
LATE = 0.2  # share of them who cross at any time of their phase, even as it ends
# From the road's middle to the first who walks, and who rides
WALK_M, RIDE_M = LANE_WIDTH_M + 1.5, LANE_WIDTH_M + 4.0


class Row(NamedTuple):
    """A row of people who cross the arm that the ego leaves by."""

    kind: ActorKind
    speed_mps: float
    start_m: float  # from the road's middle to the first of them
    people: int
    spacing_m: float


def free_side(stage: Stage) -> float:
    """Return +1 if the lane to pass by is left of the route, -1 if right."""
    here = round(float(stage.parameters.get("obstacle_m", 60.0)))
    room_m = float(stage.path.oncoming_m[here])
    return 1.0 if room_m > LANE_WIDTH_M else -1.0


def crashed_cars(stage: Stage, street: Street) -> Script:
    """Place two crashed cars askew in the lane, and a police van before them."""
    s = stage.place("obstacle_m", 62.0, 80.0)
    flows.keep_clear(stage, street.ahead(), s)
    for k, name in enumerate(("first", "second")):
        askew = stage.uniform(f"{name}_askew_rad", -0.35, 0.35)
        aside = -0.4 * free_side(stage)
        place = stage.route_pose(s + 8.0 + 7.0 * k, aside)
        stage.add_object(ActorKind.PARKED, place.turned(askew))
    stage.add_object(ActorKind.EMERGENCY, stage.route_pose(s))
    yield from flows.meet(stage, s, "crashed_cars")


def construction(stage: Stage, street: Street) -> Script:
    """Close the lane for a few metres with cones and barriers."""
    s = stage.place("obstacle_m", 62.0, 80.0)
    flows.keep_clear(stage, street.ahead(), s)
    length = stage.uniform("works_m", 8.0, 14.0)
    for k in range(4):
        place = stage.route_pose(s + 2.0 * k, -1.4 + 0.8 * k)
        stage.add_object(ActorKind.CONE, place)
    for along in (9.0, 9.0 + length):
        stage.add_object(ActorKind.BARRIER, stage.route_pose(s + along))
    for k in range(int(length // 3)):
        stage.add_object(ActorKind.CONE, stage.route_pose(s + 10.5 + 3.0 * k, 1.3))
    yield from flows.meet(stage, s, "construction")


def parked_car(stage: Stage, street: Street) -> Script:
    """Stop a car or van in the lane, its hazard lights on."""
    s = stage.place("obstacle_m", 62.0, 85.0)
    flows.keep_clear(stage, street.ahead(), s)
    kind = ActorKind(stage.choice("obstacle", ("parked", "van", "truck")))
    aside = stage.uniform("aside_m", 0.0, 0.6) * -free_side(stage)
    stage.add_object(kind, stage.route_pose(s, aside))
    yield from flows.meet(stage, s, "parked_car")


def slow_cyclists(stage: Stage, street: Street) -> Script:
    """Drive cyclists in a row, on the right part of the lane."""
    count = stage.integer("cyclists", 2, 4)
    speed = stage.uniform("cyclist_mps", 1.8, 2.4)
    first = stage.uniform("cyclist_gap_m", 26.0, 34.0)
    last: Car | None = None
    flows.keep_clear(stage, street.ahead(), first + 60.0)
    for k in range(count):
        s, kind = BEFORE_M + first + 4.5 * k, ActorKind.BICYCLE
        rider = stage.add_car(street.ahead(), s, speed, speed, kind, TOGETHER)
        rider.offset_m = -0.8
        right = rider.pose.moved(0.0, -0.8)
        rider.position[:] = (right.x, -right.y)
        last = last or rider
    while last and stage.gap_m(last) > flows.NEAR_M - 10.0:
        yield
    stage.record_trigger("slow_cyclists", last)


def opening_door(stage: Stage, street: Street) -> Script:
    """Open the door of one of a row of parked cars into the lane."""
    s = stage.place("door_m", 60.0, 80.0)
    flows.keep_clear(stage, street.ahead(), s)
    side = -(LANE_WIDTH_M / 2 + 1.05)
    for k in range(-2, 3):
        stage.add_object(ActorKind.PARKED, stage.route_pose(s + 6.5 * k, side))
    yield from flows.near(stage, s)
    hinge = side + 1.95 / 2
    pose = stage.route_pose(s + 0.6, hinge + 0.6)
    door = stage.add_object(ActorKind.DOOR, pose, (0.2, 1.2, 1.2))
    stage.record_trigger("opening_door", door)


def spun_car(stage: Stage, street: Street) -> Script:
    """Lower the grip before a car that stands across the lane."""
    # Instead of Bench2Drive's ControlLoss, which adds noise to the controls: that would
    # penalise the driver for the noise
    s = stage.place("spun_m", 80.0, 92.0)
    flows.keep_clear(stage, street.ahead(), s)
    grip = stage.uniform("grip_mps2", 3.0, 4.0)
    begin = s - stage.uniform("slick_m", 35.0, 45.0)
    askew = stage.uniform("askew_rad", 0.4, 0.7)
    place = stage.route_pose(s, -0.7 * free_side(stage))
    car = stage.add_object(ActorKind.PARKED, place.turned(askew))
    dry = stage.ego.grip_mps2
    while stage.ahead_m(begin) > 0:
        yield
    stage.ego.grip_mps2 = grip
    stage.record_trigger("spun_car", car)
    while stage.ahead_m(s + 5.0) > 0:
        yield
    stage.ego.grip_mps2 = dry


def oncoming_cars(stage: Stage, street: Street) -> Script:
    """Drive oncoming traffic, with gaps in which one can overtake."""
    traffic = flows.Traffic(stage.uniform("oncoming_gap_s", *ONCOMING_S), platoons=0.6)
    flows.stream(stage, "oncoming", [street.oncoming()], traffic)
    return iter(())


# Cars before the ego: braking, pulling out, cutting in, crawling.


def hard_brake(stage: Stage, street: Street) -> Script:
    """Brake the car ahead to a stop, where it stands for a while."""
    gap = stage.uniform("gap_m", 13.0, 18.0)
    where = stage.place("brake_m", 35.0, 60.0)
    hardest = stage.uniform("brake_mps2", 5.0, 7.0)
    speed = float(stage.ego.speed)
    car = stage.add_car(street.ahead(), BEFORE_M + gap + 5.0, speed)
    flows.keep_clear(stage, street.ahead(), where + 30.0)
    # it drives by IDM until the ego passes a place
    stands = stage.uniform("stands_s", 2.0, 6.0)
    car.target_speed = stage.uniform("lead_mps", 8.0, 10.0)
    yield from flows.near(stage, where)
    stage.record_trigger("hard_brake", car)
    car.forced_mps2 = -hardest
    yield from flows.hold(stage, car.speed / hardest + stands)
    flows.release(car, AWAY_MPS)


def pull_out(stage: Stage, street: Street) -> Script:
    """Move a parked car out in front of the ego, at a crawl."""
    s = stage.place("pull_out_m", 55.0, 75.0)
    crawl_s = stage.uniform("crawl_s", *CRAWL_S)
    side = -(LANE_WIDTH_M / 2 + 1.25)
    for along in (-13.0, -6.5, 14.0, 20.5):
        stage.add_object(ActorKind.PARKED, stage.route_pose(s + along, side))
    car = stage.add_car(street.shoulder(), BEFORE_M + s, 0.0)
    flows.stand(car)
    yield from flows.near(stage, s - 2.0)
    yield from _cut_in(stage, car, street.ahead(), 1, "pull_out", crawl_s)


def queue_cut_in(stage: Stage, street: Street) -> Script:
    """Move a car out of a standing queue in the next lane."""
    s = stage.place("cut_in_m", 55.0, 75.0)
    crawl_s = stage.uniform("crawl_s", *CRAWL_S)
    lane = street.lane - 1 if street.lane > 0 else street.lane + 1
    chain = street.ahead(lane)
    # a standing queue with room ahead of the car that leaves it
    for index in (lane, street.lane):
        flows.keep_clear(stage, street.ahead(index), s)
    places = (-14.0, -7.0, 0.0, 11.0, 18.0)
    queue = [stage.add_car(chain, BEFORE_M + s + aside, 0.0) for aside in places]
    for car in queue:
        flows.stand(car)
    # leave when the ego is near
    yield from flows.near(stage, s - 2.0)
    side = 1 if street.lane < lane else -1
    yield from _cut_in(stage, queue[2], street.ahead(), side, "queue_cut_in", crawl_s)


def ramp_cut_in(stage: Stage, ramp: Ramp) -> Script:
    """Merge slow cars from the on-ramp into the ego's lane."""
    gap = stage.uniform("ramp_gap_s", 3.0, 5.5)
    slow = stage.uniform("ramp_mps", 5, 8)
    joins = tuple(ramp.main.ahead())
    traffic = flows.Traffic(gap, (slow, slow + 1.0), joins=joins, blind_to_ego=0.5)
    cars = flows.stream(stage, "ramp_cut_in", [ramp.ramp], traffic)
    joint = stage.network.pose(ramp.ramp[-1], 30.0)
    s, _ = stage.path.project(joint.x, joint.y)
    yield from flows.encounter(stage, cars, s, "ramp_cut_in")


def slow_queue(stage: Stage, ramp: Ramp) -> Script:
    """Drive dense, slow traffic where the ego must enter; at some time it speeds up."""
    slow = stage.uniform("slow_mps", 3.0, 4.5)
    gap = stage.uniform("slow_gap_s", 3.4, 4.6)
    until = stage.uniform("slow_until_s", 25.0, 50.0)
    traffic = flows.Traffic(gap, (slow, slow + 0.5), platoons=0.1)
    cars = flows.stream(stage, "slow_queue", [ramp.main.ahead()], traffic)

    def speed_up() -> Script:
        yield from flows.hold(stage, until)
        for car in cars:
            car.target_speed += 5.0

    stage.play_script(speed_up())
    yield from flows.encounter(stage, cars, ramp.merge_s, "slow_queue")


def queue_at_light(stage: Stage, crossing: Crossing) -> Script:
    """Put a queue ahead of the ego that the light holds until it turns green."""
    line = crossing.signals["back"].line_s or crossing.approach_m
    count = stage.integer("queue", 1, 3)
    chain = crossing.way("back", crossing.move)
    begin = stage.network.length(chain[0]) - crossing.approach_m
    queue = [
        stage.add_car(chain, begin + line - 3.5 - 7.0 * k, 0.0, AWAY_MPS)
        for k in range(count)
    ]
    tail = line - 3.5 - 7.0 * (count - 1) - 2.5
    yield from flows.meet(stage, tail, "queue_at_light", queue[-1], 35.0)


def blocked_exit(stage: Stage, crossing: Crossing) -> Script:
    """Block the ego's way out of the junction with a truck, for some time."""
    chain = crossing.way("back", crossing.move)
    into = stage.uniform("into_m", 1.0, 5.0)
    truck = stage.add_car(chain[2:], into + 2.0, 0.0, kind=ActorKind.TRUCK)
    flows.stand(truck)
    leaves_s = stage.uniform("leaves_s", 18.0, 40.0)

    def leave() -> Script:
        yield from flows.hold(stage, leaves_s)
        flows.release(truck, AWAY_MPS)

    stage.play_script(leave())
    pose = truck.pose
    s, _ = stage.path.project(pose.x, pose.y)
    yield from flows.meet(stage, s, "blocked_exit", truck, 40.0)


def _cut_in(
    stage: Stage, car: Car, lanes: list[LaneIndex], side: int, name: str, crawl_s: float
) -> Script:
    """Move into the ego's lane, crawl there, drive off."""
    stage.record_trigger(name, car)
    # change lanes at a crawl, from beside the first lane of the chain
    here, _ = stage.network.lane(lanes[0]).local_coordinates(car.position)
    target, _ = stage.network.rest(lanes, float(here))
    car.change_lane(target, side)
    flows.release(car, CRAWL_MPS)
    until = stage.time_s + crawl_s
    while stage.time_s < until:
        yield
        car.forced_mps2 = -5.0 if car.speed > CRAWL_MPS + 1.0 else None
    car.indicator = 0
    flows.release(car, AWAY_MPS)


# Pedestrians and cyclists who cross the ego's way.


def walker_behind_van(stage: Stage, _: Street) -> Script:
    """Send a pedestrian out from behind a van that stands at the kerb."""
    s = stage.place("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.5, 2.5)
    van = stage.route_pose(s - 5.0, -(HALF_LANE_M + 1.1))
    stage.add_object(ActorKind.VAN, van)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.2), 6.5)
    yield from flows.step_out(stage, walker, s, "walker_behind_van")


def walker_between_cars(stage: Stage, _: Street) -> Script:
    """Send a pedestrian out between two parked cars."""
    s = stage.place("crossing_m", 60.0, 85.0)
    speed = stage.uniform("walk_mps", 1.4, 2.2)
    for aside in (-16.5, -10.0, -3.3, 3.3, 9.9):
        pose = stage.route_pose(s + aside, -(HALF_LANE_M + 1.3))
        stage.add_object(ActorKind.PARKED, pose)
    walker = _across_route(stage, s, speed, -(HALF_LANE_M + 2.4), 7.0)
    yield from flows.step_out(stage, walker, s, "walker_between_cars")


def walkers_on_zebra(stage: Stage, _: Street) -> Script:
    """Let people cross at the light, from both sides."""
    s = float(stage.parameters["crosswalk_m"])
    yield from flows.encounter(stage, walkers_at_light(stage), s, "walkers_on_zebra")


def walkers_at_light(stage: Stage) -> list[Walker]:
    """Draw people who cross while a light holds back the traffic."""
    random, schedule = stage.random("at_light"), stage.schedule
    s, walkers = float(stage.parameters["light_m"]), list[Walker]()
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
            walkers.append(walker)
        start += plan.cycle_s
    return walkers


def pedestrians_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """Send three pedestrians across the arm that the ego turns into."""
    speed = stage.uniform("walk_mps", 1.3, 2.0)
    row = Row(ActorKind.PEDESTRIAN, speed, WALK_M, 3, 1.3)
    yield from _cross_exit(stage, crossing, "pedestrians_on_exit", row)


def cyclists_on_exit(stage: Stage, crossing: Crossing) -> Script:
    """Send three cyclists across the arm that the ego turns into."""
    speed = stage.uniform("ride_mps", 2.8, 4.0)
    row = Row(ActorKind.BICYCLE, speed, RIDE_M, 3, 2.4)
    yield from _cross_exit(stage, crossing, "cyclists_on_exit", row)


def bicycle_stream(stage: Stage, crossing: Crossing) -> Script:
    """Send a long row of cyclists across the arm that the ego turns into."""
    speed = stage.uniform("ride_mps", 3.0, 4.0)
    count = stage.integer("cyclists", 4, 7)
    spacing = stage.uniform("spacing_m", 2.6, 3.6)
    row = Row(ActorKind.BICYCLE, speed, RIDE_M, count, spacing)
    yield from _cross_exit(stage, crossing, "bicycle_stream", row)


def _cross_exit(stage: Stage, crossing: Crossing, name: str, row: Row) -> Script:
    """Send a row across the arm that the ego leaves by; the second of them counts."""
    side = -1.0 if stage.choice("side", ("right", "left")) == "right" else 1.0
    out_m = 2.0 if row.kind is ActorKind.PEDESTRIAN else 3.0
    target = crossing.arm(crossing.move, out_m, -HALF_LANE_M)
    route_s, _ = stage.path.project(target.x, target.y)
    people = list[Walker]()
    for k in range(row.people):
        start = row.start_m + row.spacing_m * k
        end = LANE_WIDTH_M + 3.0 + row.spacing_m * (row.people - k)
        begin = crossing.arm(crossing.move, out_m, side * start)
        stop = crossing.arm(crossing.move, out_m, -side * end)
        line = np.array([[begin.x, begin.y], [stop.x, stop.y]])
        people.append(stage.add_walker(row.kind, line, row.speed_mps))
    yield from flows.step_out(stage, people[1], route_s, name)
    for walker in people:
        walker.going = True


def _across_route(
    stage: Stage, s_m: float, speed: float, from_m: float, to_m: float
) -> Walker:
    """Place a pedestrian who crosses the route at a right angle; offsets are left."""
    begin, end = stage.route_pose(s_m, from_m), stage.route_pose(s_m, to_m)
    line = np.array([[begin.x, begin.y], [end.x, end.y]])
    return stage.add_walker(ActorKind.PEDESTRIAN, line, speed)
