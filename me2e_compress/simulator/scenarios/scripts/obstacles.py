"""Things in the way: accidents, road works, parked cars, doors, slow cyclists."""

from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    NEAR_M,
    Traffic,
    keep_clear,
    met,
    near,
    stream,
)
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.cars import Behaviour, Car
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M
from me2e_compress.simulator.traffic.stage import Script, Stage


def free_side(stage: Stage) -> float:
    """Return +1 if the lane to pass by is left of the route, -1 if right."""
    here = round(float(stage.parameters.get("obstacle_m", 60.0)))
    left = float(stage.path.oncoming_m[here])
    return 1.0 if left > LANE_WIDTH_M else -1.0


def crashed_cars(stage: Stage, street: Street) -> Script:
    """Place two crashed cars askew in the lane, and a police van before them."""
    s = stage.place("obstacle_m", 62.0, 80.0)
    keep_clear(stage, street.ahead(), s)
    for k, name in enumerate(("first", "second")):
        askew = stage.uniform(f"{name}_askew_rad", -0.35, 0.35)
        aside = -0.4 * free_side(stage)
        place = stage.route_pose(s + 8.0 + 7.0 * k, aside)
        stage.static_object(ActorKind.PARKED, place.turned(askew))
    stage.static_object(ActorKind.EMERGENCY, stage.route_pose(s))
    yield from met(stage, s, "crashed_cars")


def construction(stage: Stage, street: Street) -> Script:
    """Close the lane for a few metres with cones and barriers."""
    s = stage.place("obstacle_m", 62.0, 80.0)
    keep_clear(stage, street.ahead(), s)
    length = stage.uniform("works_m", 8.0, 14.0)
    for k in range(4):
        stage.static_object(
            ActorKind.CONE, stage.route_pose(s + 2.0 * k, -1.4 + 0.8 * k)
        )
    for along in (9.0, 9.0 + length):
        stage.static_object(ActorKind.BARRIER, stage.route_pose(s + along))
    for k in range(int(length // 3)):
        stage.static_object(ActorKind.CONE, stage.route_pose(s + 10.5 + 3.0 * k, 1.3))
    yield from met(stage, s, "construction")


def parked_car(stage: Stage, street: Street) -> Script:
    """Stop a car or van in the lane, its hazard lights on."""
    s = stage.place("obstacle_m", 62.0, 85.0)
    keep_clear(stage, street.ahead(), s)
    kind = ActorKind(stage.choice("obstacle", ("parked", "van", "truck")))
    aside = stage.uniform("aside_m", 0.0, 0.6) * -free_side(stage)
    stage.static_object(kind, stage.route_pose(s, aside))
    yield from met(stage, s, "parked_car")


TOGETHER = Behaviour(headway_s=0.4, jam_gap_m=1.5)
"""Cyclists stay a row that is as short as it begins."""


def slow_cyclists(stage: Stage, street: Street) -> Script:
    """Drive cyclists in a row, on the right part of the lane."""
    count = stage.integer("cyclists", 2, 4)
    speed = stage.uniform("cyclist_mps", 1.8, 2.4)
    first = stage.uniform("cyclist_gap_m", 26.0, 34.0)
    last: Car | None = None
    keep_clear(stage, street.ahead(), first + 60.0)
    for k in range(count):
        s = BEFORE_M + first + 4.5 * k
        rider = stage.car(
            street.ahead(), s, speed, speed, ActorKind.BICYCLE, behaviour=TOGETHER
        )
        rider.offset_m = -0.8
        right = rider.pose.moved(0.0, -0.8)
        rider.position[:] = (right.x, -right.y)
        last = last or rider
    while last and stage.gap_m(last) > NEAR_M - 10.0:
        yield
    stage.fire("slow_cyclists", last)


def opening_door(stage: Stage, street: Street) -> Script:
    """Open the door of one of a row of parked cars into the lane."""
    s = stage.place("door_m", 60.0, 80.0)
    keep_clear(stage, street.ahead(), s)
    side = -(LANE_WIDTH_M / 2 + 1.05)
    for k in range(-2, 3):
        stage.static_object(ActorKind.PARKED, stage.route_pose(s + 6.5 * k, side))
    yield from near(stage, s)
    hinge = side + 1.95 / 2
    door = stage.static_object(
        ActorKind.DOOR, stage.route_pose(s + 0.6, hinge + 0.6), (0.2, 1.2, 1.2)
    )
    stage.fire("opening_door", door)


def spun_car(stage: Stage, street: Street) -> Script:
    """Lower the grip before a car that stands across the lane.

    Substitutes for Bench2Drive's ControlLoss, which adds noise to the controls: that
    would penalise the driver for the noise.
    """
    s = stage.place("spun_m", 80.0, 92.0)
    keep_clear(stage, street.ahead(), s)
    grip = stage.uniform("grip_mps2", 3.0, 4.0)
    begin = s - stage.uniform("slick_m", 35.0, 45.0)
    askew = stage.uniform("askew_rad", 0.4, 0.7)
    place = stage.route_pose(s, -0.7 * free_side(stage))
    car = stage.static_object(ActorKind.PARKED, place.turned(askew))
    dry = stage.ego.grip_mps2
    while stage.ahead_m(begin) > 0:
        yield
    stage.ego.grip_mps2 = grip
    stage.fire("spun_car", car)
    while stage.ahead_m(s + 5.0) > 0:
        yield
    stage.ego.grip_mps2 = dry


ONCOMING_S = (16.0, 24.0)
"""Mean gap of the oncoming traffic where one must overtake."""


def oncoming_cars(stage: Stage, street: Street) -> Script:
    """Drive oncoming traffic, with gaps in which one can overtake."""
    traffic = Traffic(stage.uniform("oncoming_gap_s", *ONCOMING_S), platoons=0.6)
    stream(stage, "oncoming", [street.oncoming()], traffic)
    return iter(())
