"""Traffic that the ego must give way to, cross or join."""

from me2e_compress.simulator.scenarios.layouts.circle import ring_way
from me2e_compress.simulator.scenarios.layouts.crossings import Crossing
from me2e_compress.simulator.scenarios.layouts.ramps import Ramp
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    Traffic,
    across,
    encounter,
    stream,
)
from me2e_compress.simulator.scenarios.scripts.synchronise import (
    arrive_together,
    meeting,
    release,
)
from me2e_compress.simulator.scene import SignalKind
from me2e_compress.simulator.traffic.cars import Behaviour, Car
from me2e_compress.simulator.traffic.network import LaneIndex
from me2e_compress.simulator.traffic.signals import Regulator
from me2e_compress.simulator.traffic.stage import Script, Stage

HEEDLESS = Behaviour(sees_ego=False)
DENSE = Behaviour(headway_s=0.8, jam_gap_m=3.0)


def oncoming_platoon(stage: Stage, crossing: Crossing) -> Script:
    """Drive oncoming traffic straight on while the ego wants to turn left."""
    cars = stage.integer("cars", 2, 4)
    yield from _platoon(stage, crossing.way("ahead", "back"), cars, "oncoming_platoon")


def platoon_from_left(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the left straight into the arm that the ego turns into."""
    cars, chain = stage.integer("cars", 2, 4), crossing.way("left", "right")
    yield from _platoon(stage, chain, cars, "platoon_from_left", crossing.sign)


def platoon_to_enter(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the right into the road that the ego turns left into."""
    cars, chain = stage.integer("cars", 2, 4), crossing.way("right", "left")
    yield from _platoon(stage, chain, cars, "platoon_to_enter", crossing.sign)


def priority_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive one car, from a random side, that has the right of way."""
    chain = _from_a_side(stage, crossing)
    if crossing.move == "right":
        chain = crossing.way("left", "right")
    yield from _platoon(stage, chain, 1, "priority_car", crossing.sign)


def crossing_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive a car from the side that must give way, and does not."""
    yield from _platoon(stage, _from_a_side(stage, crossing), 1, "crossing_car")


def _from_a_side(stage: Stage, crossing: Crossing) -> list[LaneIndex]:
    """Return a chain straight through a junction, from its left or its right."""
    side = stage.choice("from", ("left", "right"))
    return crossing.way(side, "right" if side == "left" else "left")


def flows_from_both_sides(stage: Stage, crossing: Crossing) -> Script:
    """Drive a platoon from the left and, a little later, cars from the right."""
    other = crossing.way("right", "left", crossing.lanes - 1)
    if stage.schedule is not None:
        chain = crossing.way("left", "right", crossing.lanes - 1)
        yield from _platoon(stage, chain, 1, "flows_from_both_sides")
        return
    late = stage.uniform("late_m", 8.0, 16.0)
    # cars from the right, which come a little later
    route_s, station = meeting(stage, other)
    begin, speed = max(station - route_s - late, 0.0), float(stage.ego.speed)
    for k in range(2 if crossing.move == "left" else 1):
        stage.car(other, max(begin - 14.0 * k, 0.0), speed, behaviour=DENSE)
    # a platoon from the left, timed to meet it
    chain = crossing.way("left", "right", crossing.lanes - 1)
    cars = stage.integer("cars", 2, 3)
    yield from _platoon(stage, chain, cars, "flows_from_both_sides", crossing.sign)


def near_and_far_flow(stage: Stage, crossing: Crossing) -> Script:
    """Drive fast traffic from the left to cross, slower from the right to join."""
    if stage.schedule is not None:
        chain = crossing.way("left", "right", 1)
        yield from _platoon(stage, chain, 1, "near_and_far_flow")
        return
    far = crossing.way("right", "left")
    route_s, station = meeting(stage, far)
    late = stage.uniform("late_m", 20.0, 30.0)
    for k in range(2):
        s = max(station - route_s - late - 15.0 * k, 0.0)
        stage.car(far, s, 9.0, 10.0, behaviour=DENSE)
    chain, cars = crossing.way("left", "right", 1), stage.integer("cars", 3, 5)
    yield from _platoon(stage, chain, cars, "near_and_far_flow", crossing.sign)


def ring_flow(stage: Stage, sign: Regulator) -> Script:
    """Circulate cars past the entry at which the ego waits."""
    to = stage.choice("flow_to", ("right", "ahead"))
    cars = stage.integer("cars", 2, 4)
    yield from _platoon(stage, ring_way("left", to), cars, "ring_flow", sign)


def exit_lane_flow(stage: Stage, ramp: Ramp) -> Script:
    """Keep cars beside the ego, in the lane that it must cross to reach the exit."""
    yield from _beside(stage, ramp.main.ahead(), ramp.merge_s, "exit_lane_flow", 3)


def side_flows(stage: Stage, street: Street) -> Script:
    """Keep a car beside the ego at its first change, others in the lanes beyond."""
    for lane in (2, 3) if stage.schedule is None else ():
        ahead = stage.uniform(f"lane_{lane}_m", 8.0, 25.0) * (lane * 2 - 5)
        s = BEFORE_M + 20.0 + ahead
        stage.car(street.ahead(lane), s, float(stage.ego.speed), behaviour=DENSE)
    change = float(stage.parameters["first_m"]) + 12.5
    yield from _beside(stage, street.ahead(1), change, "side_flows", 2)


def bay_flow(stage: Stage, street: Street) -> Script:
    """Drive cars past the parking bay that the ego wants to leave."""
    chain = street.ahead()
    route_s, _ = meeting(stage, chain)
    if stage.schedule is not None:
        gap = stage.uniform("bay_flow_gap_s", 3.0, 5.0)
        cars = stream(stage, "bay_flow", [chain], Traffic(gap, (5.0, 7.5), 0.4))
        yield from encounter(stage, cars, route_s, "bay_flow")
        return
    begin = BEFORE_M - stage.uniform("behind_m", 3.0, 6.0)
    lead = stage.car(chain, begin, 3.0, behaviour=HEEDLESS)
    for k in range(stage.integer("followers", 1, 3)):
        stage.car(chain, begin - 11.0 * (k + 1), 3.0, 8.0, behaviour=DENSE)
    while stage.ahead_m(route_s) > 9.0:
        _keep_beside(stage, lead, 0.0, 3.0)
        yield
    stage.fire("bay_flow", lead)
    while stage.ahead_m(route_s) > -6.0 and stage.gap_m(lead) < 0.0:
        _keep_beside(stage, lead, 0.0, 3.5)
        yield
    release(lead, 8.0)


def _platoon(
    stage: Stage,
    chain: list[LaneIndex],
    cars: int,
    name: str,
    sign: Regulator | None = None,
) -> Script:
    """Drive a row of cars, the first timed to meet the ego, and then by IDM.

    On the second road cars come by all the time.
    """
    route_s, station = meeting(stage, chain)
    if stage.schedule is not None:
        late = sign is not None and sign.kind is SignalKind.TRAFFIC_LIGHT
        late &= name == "platoon_to_enter"
        yield from across(stage, chain, route_s, name, late=late)
        return
    ratio = stage.uniform("flow_ratio", 0.9, 1.05)
    gap = stage.uniform("flow_gap_m", 11.0, 15.0)
    speed = float(stage.ego.speed)
    # cars behind each other, as far as the lane reaches back
    row = list[Car]()
    for k in range(cars):
        s = station - ratio * route_s - gap * k
        if s < 0:
            break
        behaviour = DENSE if k else HEEDLESS
        row.append(stage.car(chain, s, speed, 9.0, behaviour=behaviour))
    # a give-way sign judges by the nearest of them
    points = [meeting(stage, car.lanes) for car in row]
    if sign is not None and sign.kind is SignalKind.GIVE_WAY:
        sign.nearest_s = lambda: _nearest(row, [at for _, at in points])
        sign.conflict_s = route_s - 1.0
    yield from arrive_together(stage, row[0], route_s, points[0][1], name)


def _beside(
    stage: Stage,
    chain: list[LaneIndex],
    change_s: float,
    name: str,
    cars: int,
) -> Script:
    """Keep a car beside the ego until shortly before it changes lanes.

    On the second road cars come by all the time.
    """
    if stage.schedule is not None:
        yield from across(stage, chain, change_s, name, (2.5, 4.0))
        return
    speed = float(stage.ego.speed)
    aside = stage.uniform("beside_m", -1.5, 1.5)
    # the first car adapts to the ego, the others follow
    row = [
        stage.car(chain, BEFORE_M + aside - 13.0 * k, speed, behaviour=DENSE)
        for k in range(cars)
    ]
    lead = row[0]
    lead.behaviour = HEEDLESS
    # level with the ego until it is close, then at a steady speed
    while stage.ahead_m(change_s) > 22.0:
        _keep_beside(stage, lead, aside)
        yield
    stage.fire(name, lead)
    steady = float(stage.ego.speed)
    while stage.ahead_m(change_s) > -14.0 and abs(stage.gap_m(lead)) < 12.0:
        lead.forced_mps2 = min(max((steady - lead.speed) / 0.3, -3.0), 3.0)
        yield
    release(lead, max(steady, 7.0))


def _keep_beside(
    stage: Stage, car: Car, aside_m: float, slowest_mps: float = 0.0
) -> None:
    """Hold a car level with the ego, ``aside_m`` before it."""
    pose = car.pose
    s, _ = stage.path.project(pose.x, pose.y, stage.ego_s)
    error = s - stage.ego_s - aside_m
    wanted = max(stage.ego.speed - 0.8 * error, slowest_mps)
    car.forced_mps2 = min(max((wanted - car.speed) / 0.3, -6.0), 5.0)


def _nearest(row: list[Car], stations: list[float]) -> float:
    """Return the seconds until the next car of a row is at its meeting point."""
    soonest = float("inf")
    for car, station in zip(row, stations, strict=True):
        left = station - car.station_m
        if not car.gone and left > -car.LENGTH / 2:
            soonest = min(soonest, max(left, 0.0) / max(car.speed, 1.0))
    return soonest
