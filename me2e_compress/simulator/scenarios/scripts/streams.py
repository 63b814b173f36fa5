"""Traffic, drawn before the route begins, whatever the ego does."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.bodies import Walker
from me2e_compress.simulator.traffic.cars import Behaviour, Car
from me2e_compress.simulator.traffic.network import LaneIndex
from me2e_compress.simulator.traffic.right_of_way import DECIDE_M
from me2e_compress.simulator.traffic.stage import Script, Stage, arrival_times, is_free

# Timing of scripts: meeting points, and what waits for the ego.


NEAR_M = 30.0
"""A standing obstacle counts as met when the ego is this close."""
TOUCH_M = 1.0


def meeting(stage: Stage, chain: Sequence[LaneIndex]) -> float:
    """Find where a chain of lanes meets the ego's route.

    Returns the arc length on the route of the first crossing, or of the place where the
    one joins the other.
    """
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


def steps_out(stage: Stage, walker: Walker, route_s: float) -> Script:
    """Start a walker, who crosses the route at ``route_s``, once the ego is near."""
    walker.crosses = True
    yield from near(stage, route_s)
    walker.going = True


def met(stage: Stage, route_s: float, name: str) -> Script:
    """Note that the ego has come near a standing obstacle."""
    while stage.ahead_m(route_s) > NEAR_M:
        yield
    stage.fire(name)


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


HEEDLESS, SLOW = 0.12, 0.15
"""Shares of drivers who follow closely and take short gaps, and of slow ones: our
choice."""
BLIND_TO_EGO = 0.4
"""Share of drivers of a conflict who do not make room for an ego that comes in."""
TURNING = 0.4
"""Share of traffic that turns at a junction."""
AHEAD_M, BEHIND_M, OTHER_M = 25.0, 8.0, 10.0
"""The ego and another meet if one is so far before or after the place of the conflict,
the other so near to it: the ego waits at a line before it."""
END_M = 12.0
"""Nobody begins so near to the end of the map."""
EGO_ROOM_M = 14.0
"""Nobody begins nearer to the ego, bumper to bumper."""


@dataclass(frozen=True)
class Traffic:
    """Who drives on a lane.

    Attributes:
        gap_s: Mean time between two cars.
        speed: Lowest and highest wanted speed; None for about the limit.
        platoons: Share of arrivals that lead a platoon.
        reckless: Share of drivers who obey neither lights nor signs.
        joins: The chain that they join where their lane ends.
        blind_to_ego: Share of drivers who do not mind the ego.
    """

    gap_s: float
    speed: tuple[float, float] | None = None
    platoons: float = 0.25
    reckless: float = 0.0
    joins: tuple[LaneIndex, ...] = ()
    blind_to_ego: float = 0.0


def stream(
    stage: Stage, name: str, chains: Sequence[Sequence[LaneIndex]], traffic: Traffic
) -> list[Car]:
    """Draw the cars that come by one lane and take one of several chains from there.

    Those that came before the route began are on the lane already.
    """
    random, network, entry = stage.random(name), stage.network, chains[0][0]
    schedule = stage.schedule
    schedule.claimed.append(entry)
    low, high = traffic.speed or (0.0, 0.0)
    usual = (low + high) / 2 or 0.85 * float(network.lane(entry).speed_limit)
    free_m = _free_m(stage, chains[0])
    weights = np.array([_weight(stage, chain, chains) for chain in chains])
    clear = stage.clear.get(entry, (0.0, 0.0))
    cars = list[Car]()
    for time_s in arrival_times(
        random, traffic.gap_s, -free_m / usual, traffic.platoons
    ):
        chain = chains[int(random.choice(len(chains), p=weights / weights.sum()))]
        at = max(-time_s, 0.0) * usual
        car = _driver(stage, random, chain, at, traffic)
        if time_s >= 0.0:
            schedule.add(time_s, car)
        elif not clear[0] < at < clear[1] and _has_room(stage, car):
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
    limit = float(stage.network.lane(chain[0]).speed_limit)
    heedless, slow, kind, reckless = random.random(4)
    wanted = limit * random.uniform(0.85, 1.0)
    if traffic.speed is not None:
        wanted = random.uniform(*traffic.speed)
    elif slow < SLOW:
        wanted *= random.uniform(0.6, 0.75)
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
    vehicle = ActorKind.VAN if kind < 0.12 else ActorKind.CAR
    vehicle = ActorKind.TRUCK if kind > 0.93 else vehicle
    wanted = float(wanted)
    car = stage.coming(chain, s_m, wanted, wanted, vehicle, mind)
    car.joins = list(traffic.joins) or None
    if traffic.blind_to_ego and random.random() < traffic.blind_to_ego:
        car.behaviour = replace(mind, sees_ego=False)
    return car


def _free_m(stage: Stage, chain: Sequence[LaneIndex]) -> float:
    """Return how far on a chain cars may be as a route begins.

    Nobody is so near to a junction that it is too late to decide.
    """
    length = 0.0
    for index in chain:
        if index in stage.network.ranks:
            return length - DECIDE_M
        length += stage.network.length(index)
    return length - END_M


def _weight(
    stage: Stage, chain: Sequence[LaneIndex], chains: Sequence[Sequence[LaneIndex]]
) -> float:
    """Return how often a chain is taken: most go straight on."""
    ranks = [stage.network.ranks.get(index, 0) for index in chain]
    turns = any(rank % 3 for rank in ranks)
    return TURNING / len(chains) if turns else 1.0 - TURNING


def _has_room(stage: Stage, car: Car) -> bool:
    x, y = car.position
    ex, ey = stage.ego.position
    if math.hypot(x - ex, y - ey) < EGO_ROOM_M + (car.LENGTH + stage.ego.LENGTH) / 2:
        return False
    return is_free(car, [*stage.bodies, *stage.static_objects])


def across(
    stage: Stage,
    chain: Sequence[LaneIndex],
    route_s: float,
    name: str,
    gap_s: tuple[float, float] = (5.0, 9.0),
    late: bool = False,
) -> Script:
    """Drive traffic that the ego's route crosses or joins; see `encounter`.

    With ``late``, some of it comes through a light that is red.
    """
    reckless = 0.45 if late or name == "crossing_car" else 0.0
    gap = stage.uniform(f"{name}_gap_s", *gap_s)
    traffic = Traffic(gap, reckless=reckless, blind_to_ego=BLIND_TO_EGO)
    cars = stream(stage, name, [chain], traffic)
    yield from encounter(stage, cars, route_s, name)


def encounter(
    stage: Stage, others: Sequence[Car | Walker], route_s: float | None, name: str
) -> Script:
    """Note that the ego and one of some others are at a place together.

    Without a place: wherever they meet.
    """
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
                stage.fire(name, body)
                return


TRIGGERED = (
    *("DynamicObjectCrossing", "HardBreakRoute", "ParkingCrossingPedestrian"),
    *("ParkingCutIn", "StaticCutIn", "VehicleOpensDoorTwoWays"),
    *("CrossingBicycleFlow", "VehicleTurningRoute", "VehicleTurningRoutePedestrian"),
)
"""Types in which somebody waits for the ego, as in scenario_runner."""
TRIGGER_M, DELAY_S = (18.0, 36.0), (0.0, 1.0)
"""Where the ego sets off what waits for it, and how long that still waits.
scenario_runner's actors start when the ego is within a distance; ours is drawn."""


def near(stage: Stage, route_s: float) -> Script:
    """Wait until the ego's front is near a place, and a little longer."""
    metres = stage.uniform("trigger_m", *TRIGGER_M)
    delay = stage.uniform("delay_s", *DELAY_S)
    while stage.ahead_m(route_s) - stage.ego.LENGTH / 2 > metres:
        yield
    until = stage.time_s + delay
    while stage.time_s < until:
        yield
