"""Scripts of traffic, drawn before the route begins, and how scripts are timed.

Scripts are generators that are resumed at every decision (10 Hz). What waits for the
ego, as in scenario_runner, is triggered by its position and a delay that is drawn.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from me2e_compress.simulator.scenarios.crossings import Crossing, ring_way
from me2e_compress.simulator.scenarios.roads import BEFORE_M, Ramp, Street
from me2e_compress.simulator.scene import ActorKind, Event, EventKind
from me2e_compress.simulator.traffic.bodies import Behaviour, Car, Walker
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M, LaneIndex
from me2e_compress.simulator.traffic.right_of_way import DECIDE_M, Regulator
from me2e_compress.simulator.traffic.stage import Script, Stage, arrival_times, is_free

NEAR_M = 30.0  # a standing obstacle counts as met when the ego is this close
TOUCH_M = 1.0
HEEDLESS, SLOW = 0.12, 0.15  # shares of close followers, of slow drivers
LATE = 0.45  # share of drivers of a conflict who obey neither lights nor signs
BLIND_TO_EGO = 0.4  # share of drivers of a conflict who make the ego no room
TURNING = 0.4  # share of traffic that turns at a junction
# The ego and another meet if one is so far before or after the place of the conflict,
# the other so near to it: the ego waits at a line before it
AHEAD_M, BEHIND_M, OTHER_M = 25.0, 8.0, 10.0
END_M = 12.0  # nobody begins so near to the end of the map
EGO_ROOM_M = 14.0  # nobody begins nearer to the ego, bumper to bumper
# Where the ego sets off what waits for it, and how long that still waits.
# scenario_runner's actors start when the ego is within a distance; ours is drawn.
TRIGGER_M, DELAY_S = (18.0, 36.0), (0.0, 1.0)
DENSE_S = (2.5, 4.0)  # mean gap in the lane that the ego changes into
# Share of the oncoming cars that drive partly in the ego's lane, and how far they reach
# into it
INVADING, INTO_M = 0.4, (0.9, 1.2)
ASIDE_M = 1.1  # how far right of its lane's centre traffic keeps there, to have room
SPARSE_S = 20.0  # mean gap where an emergency vehicle comes: others make room
# The ego has not yielded if the vehicle was this close behind for this long, and still
# is behind at the end: it may come too late to be let by
HELD_UP_M, HELD_UP_S = 20.0, 4.0


# Timing of scripts: meeting points, and what waits for the ego.


def meeting(stage: Stage, chain: Sequence[LaneIndex]) -> float:
    """Return the arc length of the route where a chain of lanes first meets it."""
    points = np.concatenate([stage.network.centre(index) for index in chain])
    route = stage.path.points
    away = np.hypot(
        route[:, None, 0] - points[None, :, 0], route[:, None, 1] - points[None, :, 1]
    )
    nearest = away.min(axis=1)
    touching = np.flatnonzero(nearest < TOUCH_M)
    i = int(touching[0]) if len(touching) else int(np.argmin(nearest))
    for _ in range(2):
        i += int(i + 1 < len(nearest) and nearest[i + 1] < nearest[i])
    return float(i)


def step_out(stage: Stage, walker: Walker, route_s: float, name: str) -> Script:
    """Start a walker, who crosses the route at ``route_s``, once the ego is near."""
    walker.crosses = True
    yield from near(stage, route_s)
    walker.going = True
    stage.record_trigger(name, walker)


def meet(
    stage: Stage,
    route_s: float,
    name: str,
    body: Car | None = None,
    within_m: float = NEAR_M,
) -> Script:
    """Record the event of a script once the ego has come near a place."""
    while stage.ahead_m(route_s) > within_m:
        yield
    stage.record_trigger(name, body)


def hold(stage: Stage, seconds: float) -> Script:
    """Wait for some seconds."""
    end = stage.time_s + seconds
    while stage.time_s < end:
        yield


def stand(car: Car) -> None:
    """Keep a car where it is."""
    car.forced_mps2 = -4.0


def release(car: Car, target_mps: float) -> None:
    """Let a car drive by IDM."""
    car.forced_mps2, car.target_speed = None, target_mps


def keep_clear(stage: Stage, chain: Sequence[LaneIndex], until_s: float) -> None:
    """Let no traffic begin on a lane between the ego and a place of its route."""
    stage.clear[chain[0]] = (BEFORE_M - 8.0, BEFORE_M + until_s + 30.0)


@dataclass(frozen=True)
class Traffic:
    """Who drives on a lane."""

    gap_s: float  # mean time between two cars
    speed: tuple[float, float] | None = None  # range; None for about the limit
    platoons: float = 0.25  # share of arrivals that lead a platoon
    reckless: float = 0.0  # share of drivers who obey neither lights nor signs
    joins: tuple[LaneIndex, ...] = ()  # the chain that they join where their lane ends
    blind_to_ego: float = 0.0  # share of drivers who do not mind the ego


def stream(
    stage: Stage, name: str, chains: Sequence[Sequence[LaneIndex]], traffic: Traffic
) -> list[Car]:
    """Draw the cars that come by one lane and take one of several chains from there."""
    # Those that came before the route began are on the lane already
    random, network, entry = stage.random(name), stage.network, chains[0][0]
    schedule = stage.schedule
    schedule.claimed.append(entry)
    low, high = traffic.speed or (0.0, 0.0)
    usual = (low + high) / 2 or 0.85 * float(network.lane(entry).speed_limit)
    free_m = _free_m(stage, chains[0])
    # most go straight on
    ranks = [[network.ranks.get(index, 0) for index in chain] for chain in chains]
    turns = np.array([any(rank % 3 for rank in several) for several in ranks])
    weights = np.where(turns, TURNING / len(chains), 1.0 - TURNING)
    clear = stage.clear.get(entry, (0.0, 0.0))
    cars, begin_s = list[Car](), -free_m / usual
    for time_s in arrival_times(random, traffic.gap_s, begin_s, traffic.platoons):
        chain = chains[int(random.choice(len(chains), p=weights / weights.sum()))]
        at = max(-time_s, 0.0) * usual
        car = _driver(stage, random, chain, at, traffic)
        to_ego_m = math.hypot(*(car.position - stage.ego.position))
        far_enough = to_ego_m >= EGO_ROOM_M + (car.LENGTH + stage.ego.LENGTH) / 2
        if time_s >= 0.0:
            schedule.add(time_s, car)
        elif clear[0] < at < clear[1] or not far_enough:
            continue
        elif is_free(car, [*stage.bodies, *stage.static_objects]):
            stage.bodies.append(car)
        else:
            continue
        cars.append(car)
    return cars


def _driver(
    stage: Stage,
    random: np.random.Generator,
    chain: Sequence[LaneIndex],
    s_m: float,
    traffic: Traffic,
) -> Car:
    """Draw one driver with a vehicle."""
    # its wanted speed
    limit = float(stage.network.lane(chain[0]).speed_limit)
    heedless, slow, kind, reckless = random.random(4)
    wanted = limit * float(random.uniform(0.85, 1.0))
    if traffic.speed is not None:
        wanted = float(random.uniform(*traffic.speed))
    elif slow < SLOW:
        wanted *= float(random.uniform(0.6, 0.75))
    # its mind
    mind = Behaviour(
        acceleration_mps2=float(random.uniform(1.5, 3.0)),
        jam_gap_m=float(random.uniform(2.0, 3.5)),
        headway_s=float(random.uniform(1.0, 1.8)),
        gap_s=float(random.uniform(1.0, 2.0)),
        obeys_rules=bool(reckless >= traffic.reckless),
        changes_lanes=not traffic.joins,
        politeness=float(random.uniform(0.0, 0.3)),
    )
    if heedless < HEEDLESS:
        mind = replace(mind, headway_s=0.7, jam_gap_m=1.8, gap_s=0.5)
    # its vehicle
    vehicle = ActorKind.VAN if kind < 0.12 else ActorKind.CAR
    vehicle = ActorKind.TRUCK if kind > 0.93 else vehicle
    car = stage.add_car(chain, s_m, wanted, wanted, vehicle, mind, comes=True)
    car.joins = list(traffic.joins) or None
    if traffic.blind_to_ego and random.random() < traffic.blind_to_ego:
        car.behaviour = replace(mind, sees_ego=False)
    return car


def _free_m(stage: Stage, chain: Sequence[LaneIndex]) -> float:
    """Return how far on a chain cars may be as a route begins."""
    # Nobody is so near to a junction that it is too late to decide
    length = 0.0
    for index in chain:
        if index in stage.network.ranks:
            return length - DECIDE_M
        length += stage.network.length(index)
    return length - END_M


def across(
    stage: Stage,
    chain: Sequence[LaneIndex],
    name: str,
    route_s: float | None = None,
    gap_s: tuple[float, float] = (5.0, 9.0),
    late: bool = False,
) -> Script:
    """Drive traffic that the ego's route crosses or joins; see `encounter`.

    Without ``route_s``: where they meet. With ``late``, some of it comes through a
    light that is red, or takes priority.
    """
    place = meeting(stage, chain) if route_s is None else route_s
    gap = stage.uniform(f"{name}_gap_s", *gap_s)
    reckless = LATE if late else 0.0
    traffic = Traffic(gap, reckless=reckless, blind_to_ego=BLIND_TO_EGO)
    cars = stream(stage, name, [chain], traffic)
    yield from encounter(stage, cars, place, name)


def encounter(
    stage: Stage, others: Sequence[Car | Walker], route_s: float | None, name: str
) -> Script:
    """Record that the ego meets one of some others: at a place, or anywhere if None."""
    place = None if route_s is None else stage.route_pose(route_s)
    while True:
        yield
        at = place or stage.ego.pose
        if route_s is not None and not -BEHIND_M < stage.ahead_m(route_s) < AHEAD_M:
            continue
        for body in others:
            x, y = body.position
            near = math.hypot(x - at.x, -y - at.y) < OTHER_M
            if near and body.road is not None:
                stage.record_trigger(name, body)
                return


def near(stage: Stage, route_s: float) -> Script:
    """Wait until the ego's front is near a place, and a little longer."""
    metres = stage.uniform("trigger_m", *TRIGGER_M)
    delay = stage.uniform("delay_s", *DELAY_S)
    while stage.ahead_m(route_s) - stage.ego.LENGTH / 2 > metres:
        yield
    yield from hold(stage, delay)


# Traffic that the ego must give way to, cross or join.


def platoon(
    stage: Stage,
    crossing: Crossing,
    name: str,
    origin: str,
    to: str,
    cars: bool = True,
    late: bool = False,
) -> Script:
    """Drive traffic between two arms of a junction, in the far lane; see `across`."""
    # Decides nothing, but the routes that ship were admitted with it
    if cars:
        stage.integer("cars", 2, 4)
    chain = crossing.way(origin, to, crossing.lanes - 1)
    yield from across(stage, chain, name, late=late)


# Oncoming traffic drives straight on while the ego wants to turn left
ONCOMING = partial(platoon, name="oncoming_platoon", origin="ahead", to="back")
# Cars come from the left straight into the arm that the ego turns into
FROM_LEFT = partial(platoon, name="platoon_from_left", origin="left", to="right")
# Cars come from the right into the road that the ego turns left into
TO_ENTER = partial(platoon, name="platoon_to_enter", origin="right", to="left")


def priority_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars, from a random side, that have the right of way."""
    chain = _from_a_side(stage, crossing)
    if crossing.move == "right":
        chain = crossing.way("left", "right")
    yield from across(stage, chain, "priority_car")


def crossing_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the side that must give way; some do not."""
    chain = _from_a_side(stage, crossing)
    yield from across(stage, chain, "crossing_car", late=True)


def _from_a_side(stage: Stage, crossing: Crossing) -> list[LaneIndex]:
    """Return a chain straight through a junction, from its left or its right."""
    side = stage.choice("from", ("left", "right"))
    return crossing.way(side, "right" if side == "left" else "left")


def ring_flow(stage: Stage, _: Regulator) -> Script:
    """Circulate cars past the entry at which the ego waits."""
    to = stage.choice("flow_to", ("right", "ahead"))
    stage.integer("cars", 2, 4)  # as in `platoon`
    yield from across(stage, ring_way("left", to), "ring_flow")


def exit_lane_flow(stage: Stage, ramp: Ramp) -> Script:
    """Drive dense traffic in the lane that the ego must cross to reach the exit."""
    lane, place = ramp.main.ahead(), ramp.merge_s
    yield from across(stage, lane, "exit_lane_flow", place, DENSE_S)


def side_flows(stage: Stage, street: Street) -> Script:
    """Drive dense traffic in the lane of the ego's first change."""
    change = float(stage.parameters["first_m"]) + 12.5
    yield from across(stage, street.ahead(1), "side_flows", change, DENSE_S)


def bay_flow(stage: Stage, street: Street) -> Script:
    """Drive cars past the parking bay that the ego wants to leave."""
    chain = street.ahead()
    route_s = meeting(stage, chain)
    gap = stage.uniform("bay_flow_gap_s", 3.0, 5.0)
    cars = stream(stage, "bay_flow", [chain], Traffic(gap, (5.0, 7.5), 0.4))
    yield from encounter(stage, cars, route_s, "bay_flow")


# Lights, signs, and vehicles that take or demand priority.


def red_light(stage: Stage, crossing: Crossing) -> Script:
    """Record that the ego comes to a light which its plan keeps red then."""
    line_s = crossing.signals["back"].line_s or crossing.approach_m
    yield from meet(stage, line_s, "red_light", within_m=35.0)


def stop_sign(stage: Stage, crossing: Crossing) -> Script:
    """Wait for the ego at a stop sign without traffic: only the stop counts."""
    sign = crossing.signals["back"]
    yield from meet(stage, sign.line_s or crossing.approach_m, "stop_sign")


def invader(stage: Stage, street: Street) -> Script:
    """Drive oncoming traffic, a share of it partly in the ego's lane."""
    gap, random = stage.uniform("oncoming_gap_s", 4.0, 7.0), stage.random("invaders")
    keep_clear(stage, street.ahead(), 60.0)
    for car in stream(stage, "same_way", [street.ahead()], Traffic(2 * gap)):
        car.offset_m = -ASIDE_M
    cars = stream(stage, "oncoming", [street.oncoming()], Traffic(gap))
    invaders = [car for car in cars if random.random() < INVADING]
    for car in invaders:
        into = float(random.uniform(*INTO_M))
        car.offset_m = (LANE_WIDTH_M - car.WIDTH) / 2 + into
        car.behaviour = replace(car.behaviour, sees_ego=False)
    yield from encounter(stage, invaders, None, "invader")


def emergency_behind(stage: Stage, street: Street) -> Script:
    """Let an emergency vehicle come from behind that wants to pass."""
    # Whether the ego yielded is decided at the end of the route. scenario_runner's
    # YieldToEmergencyVehicleTest only asks whether the vehicle is ahead then.
    lanes = street.ahead()
    mind = Behaviour(
        3.5, headway_s=0.5, jam_gap_m=4.0, obeys_limits=False, obeys_rules=False
    )
    begin = BEFORE_M - stage.uniform("behind_m", 24.0, 56.0)
    car = stage.add_car(lanes, begin, 16.0, 20.0, ActorKind.EMERGENCY, mind)
    stream(stage, "same_way", [lanes], Traffic(SPARSE_S))
    delay_s = 0.0

    def yield_event() -> Event | None:
        if delay_s < HELD_UP_S or stage.gap_m(car) > 0:
            return None
        return stage.event(EventKind.YIELD_EMERGENCY, "it was held up", car)

    stage.at_goal.append(yield_event)
    while True:
        yield
        if -HELD_UP_M < stage.gap_m(car) < 0:
            if delay_s == 0.0:
                stage.record_trigger("emergency_behind", car)
            delay_s += 0.1
