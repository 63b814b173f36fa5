"""Roads without junctions: several lanes one way, one lane each way, with parking."""

import math
from collections.abc import Sequence
from dataclasses import replace

from me2e_compress.simulator.plane_geometry import Command
from me2e_compress.simulator.scenarios.layouts.road import (
    BEFORE_M,
    Piece,
    Street,
    lay_road,
)
from me2e_compress.simulator.scene import SignalKind
from me2e_compress.simulator.traffic.legs import Leg
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.signals import Regulator, SignalPlan
from me2e_compress.simulator.traffic.stage import GOAL_M, Stage

BEYOND_M = 120.0
"""Road beyond the goal."""
TOTAL_M = BEFORE_M + GOAL_M + BEYOND_M
PARKING_M = 2.5
"""Width of a parking lane."""


def straight(stage: Stage) -> tuple[Piece, ...]:
    """Return the one piece of a straight road, with road behind and beyond."""
    return (Piece(TOTAL_M + stage.more_m),)


def origin(stage: Stage) -> Pose:
    """Return the pose at which the world begins, with a random heading."""
    return Pose(0.0, 0.0, stage.uniform("heading_rad", -math.pi, math.pi))


def start_speed(stage: Stage) -> float:
    """Return the ego's speed at frame 0 (m/s)."""
    return stage.uniform("speed_mps", 7.0, 10.0)


def multilane(stage: Stage) -> Street:
    """Lay a straight one-way road of two or three lanes and a narrow shoulder."""
    lanes, lane = _lanes(stage)
    return _street(stage, Section(lanes, limit_mps=14.0), 1.0, lane=lane)


def single_lane(stage: Stage) -> Street:
    """Lay a straight one-way road of one lane, without room to overtake."""
    return with_light(stage, _street(stage, Section(limit_mps=14.0), 0.5), 0.5)


def bend(stage: Stage) -> Street:
    """Lay a one-way road of two or three lanes through a bend."""
    lanes, lane = _lanes(stage)
    pieces = _curve(stage, 60.0, 100.0)
    return _street(stage, Section(lanes, limit_mps=14.0), 1.0, pieces, lane=lane)


def two_way(stage: Stage) -> Street:
    """Lay a straight road, one lane each way; overtaking uses the oncoming lane."""
    street = _street(stage, Section(limit_mps=13.0), 0.6, oncoming=1)
    return with_light(stage, street, 0.6)


def two_way_bend(stage: Stage) -> Street:
    """Lay a winding road with one lane each way and a paved shoulder."""
    pieces = _curve(stage, 50.0, 90.0)
    return _street(stage, Section(limit_mps=12.0), 1.8, pieces, oncoming=1)


def parking_street(stage: Stage) -> Street:
    """Lay a street with one lane each way and a parking lane on either side."""
    street = _street(stage, Section(limit_mps=12.0), PARKING_M, oncoming=1)
    return with_light(stage, street, PARKING_M)


def parking_bay(stage: Stage) -> Street:
    """Lay the parking street; the ego starts, at rest, in the parking lane."""
    section = Section(limit_mps=12.0)
    street = lay_road(
        stage.network, "r", origin(stage), straight(stage), section, 1, PARKING_M
    )
    stay = stage.uniform("stay_m", 8.0, 12.0)
    (bay,), (lane,) = street.shoulder(), street.ahead()
    legs = [
        Leg(bay, enter_m=BEFORE_M, leave_m=BEFORE_M + stay),
        Leg(lane, Command.CHANGE_LEFT, enter_m=BEFORE_M + stay + 14.0),
    ]
    stage.drive(legs, 2.0)
    return street


def zebra_street(stage: Stage) -> Street:
    """Lay a two-way street with a crosswalk, and lights at it."""
    street = _street(stage, Section(limit_mps=13.0), 0.6, oncoming=1)
    s = stage.place("crosswalk_m", 55.0, 80.0)
    return with_light(stage, street, 0.6, s)


GREEN_S, WALK_S = (14.0, 24.0), 8.0
"""Green for the traffic, and for people on foot: they walk 8 m at 1.2 m/s in 6.7 s."""
LIGHT_M = 125.0
"""A light stands at least so far behind the place of a conflict's beginning."""


def with_light(
    stage: Stage, street: Street, shoulder_m: float, s_m: float | None = None
) -> Street:
    """Put a light for people on foot at a straight road.

    It is near the goal unless ``s_m`` says where.
    """
    at = s_m or stage.uniform("light_m", stage.lead_m + LIGHT_M, stage.goal_m - 18.0)
    stage.parameters.setdefault("light_m", at)
    # the crosswalk, and where people begin and end
    ways = 2 if street.backward else 1
    left, right = (ways - 0.5) * LANE_WIDTH_M, -0.5 * LANE_WIDTH_M
    beyond = shoulder_m + 0.8
    stage.light_across_m = (right - beyond, left + beyond)
    places = ((-2.0, left), (2.0, left), (2.0, right), (-2.0, right))
    stage.add_crosswalk([stage.route_pose(at + along, side) for along, side in places])
    # lights both ways, and their plan
    kind, lights = SignalKind.TRAFFIC_LIGHT, list[Regulator]()
    lights.append(stage.regulate(kind, stage.route_pose(at - 3.5)))
    (lane,) = street.ahead()[:1]
    stage.schedule.lines[lane] = [(BEFORE_M + at - 3.5, lights[0])]
    if street.backward:
        line = stage.route_pose(at + 3.5, LANE_WIDTH_M).turned(math.pi)
        lights.append(stage.regulate(kind, line))
        (lane,) = street.oncoming()[:1]
        length = stage.network.length(lane)
        stage.schedule.lines[lane] = [(length - BEFORE_M - at - 3.5, lights[1])]
    green = stage.uniform("green_s", *GREEN_S), WALK_S
    plan = SignalPlan((lights, ()), green, 0.0)
    offset = stage.uniform("offset_s", 0.0, plan.cycle_s)
    stage.schedule.plans.append(replace(plan, offset_s=offset))
    return street


def _lanes(stage: Stage) -> tuple[int, int]:
    """Return two or three lanes, and the one in which the ego drives."""
    lanes = stage.integer("lanes", 2, 3)
    return lanes, min(stage.integer("ego_lane", 0, lanes - 1), lanes - 1)


def _curve(stage: Stage, tightest: float, widest: float) -> tuple[Piece, ...]:
    radius = stage.uniform("radius_m", tightest, widest)
    side = 1.0 if stage.choice("bend", ("left", "right")) == "left" else -1.0
    before, after = BEFORE_M + 30.0 + stage.lead_m, stage.goal_m - stage.lead_m
    after += BEYOND_M - 90.0
    return Piece(before), Piece(radius, side * (60.0 / radius)), Piece(after)


def _street(
    stage: Stage,
    section: Section,
    shoulder_m: float,
    pieces: Sequence[Piece] = (),
    lane: int = 0,
    oncoming: int = 0,
) -> Street:
    """Lay a road whose lane the ego follows to the goal."""
    start, pieces = origin(stage), pieces or straight(stage)
    road = lay_road(stage.network, "r", start, pieces, section, oncoming, shoulder_m)
    first, *others = road.ahead(lane)
    legs = [Leg(first, enter_m=BEFORE_M), *(Leg(index) for index in others)]
    stage.drive(legs, start_speed(stage))
    return replace(road, lane=lane)
