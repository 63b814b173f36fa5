"""Fast roads: an on-ramp, an off-ramp, a lane that ends."""

import math
from dataclasses import dataclass, replace

from me2e_compress.simulator.plane_geometry import Command, LaneMarking
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street, lay_road
from me2e_compress.simulator.scenarios.layouts.streets import (
    TOTAL_M,
    origin,
    start_speed,
    straight,
)
from me2e_compress.simulator.scene import ActorKind
from me2e_compress.simulator.traffic.legs import Leg
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.stage import Stage

LIMIT_MPS = 14.0
RAMP_RADIUS_M = 80.0
RAMP_APART_M = 7.0
"""Sideways distance between the ramp's straight and the lane it becomes."""
CHANGE_M = 25.0
"""Length of a lane change."""


@dataclass(frozen=True)
class Ramp:
    """A fast main road and a lane that leads onto it or off it.

    Attributes:
        main: The main road, and its lane beside the ramp.
        ramp: The chain of the ramp, the lane beside the main road included; empty
            where a lane just ends.
        merge_s: Arc length on the ego's route where it changes between ramp and main
            road.
    """

    main: Street
    ramp: list[LaneIndex]
    merge_s: float


def on_ramp(stage: Stage, ego_on_ramp: bool) -> Ramp:
    """Lay a ramp that joins from the right and runs beside the main road."""
    start, section = origin(stage), Section(2, limit_mps=LIMIT_MPS)
    # main road
    main = replace(
        lay_road(stage.network, "m", start, straight(stage), section), lane=1
    )
    single = replace(section, lanes=1)
    beside = replace(single, left=LaneMarking.DASHED)
    # ramp: straight, an S-bend, then the acceleration lane
    angle = math.acos(1 - RAMP_APART_M / (2 * RAMP_RADIUS_M))
    apart = -2 * LANE_WIDTH_M - RAMP_APART_M
    net, length = stage.network, BEFORE_M + stage.place("ramp_m", 15.0, 25.0)
    pose = net.straight("p0", "p1", start.moved(0.0, apart), length, single)
    pose = net.arc("p1", "p2", pose, RAMP_RADIUS_M, angle, single)
    pose = net.arc("p2", "p3", pose, RAMP_RADIUS_M, -angle, single)
    lane_m = stage.uniform("acceleration_lane_m", 65.0, 80.0)
    pose = net.straight("p3", "p4", pose, lane_m, beside)
    net.closed.append(("p3", "p4", 0))
    block_end(stage, pose)
    ramp: list[LaneIndex] = [(f"p{k}", f"p{k + 1}", 0) for k in range(4)]
    # the ego's route
    if not ego_on_ramp:
        legs = [Leg(main.ahead()[0], enter_m=BEFORE_M)]
        stage.drive(legs, start_speed(stage))
        return Ramp(main, ramp, 0.0)
    begun = length + 2 * RAMP_RADIUS_M * math.sin(angle)
    leave = stage.uniform("leave_m", 15.0, 25.0)
    legs = [
        Leg(ramp[0], enter_m=BEFORE_M),
        Leg(ramp[1]),
        Leg(ramp[2]),
        Leg(ramp[3], leave_m=leave),
        Leg(main.ahead()[0], Command.CHANGE_LEFT, begun + leave + CHANGE_M),
    ]
    stage.drive(legs, start_speed(stage))
    return Ramp(main, ramp, _beside(stage, start, begun + leave + CHANGE_M / 2))


def off_ramp(stage: Stage) -> Ramp:
    """Lay an exit on the right; the ego starts in the left lane of the main road."""
    start, section = origin(stage), Section(2, limit_mps=LIMIT_MPS)
    # main road
    main = replace(
        lay_road(stage.network, "m", start, straight(stage), section), lane=1
    )
    single = replace(section, lanes=1)
    beside = replace(single, left=LaneMarking.DASHED)
    # ramp: a lane beside the main road, then an S-bend away from it
    angle = math.acos(1 - RAMP_APART_M / (2 * RAMP_RADIUS_M))
    first = stage.place("change_m", 40.0, 55.0)
    opens = BEFORE_M + first + CHANGE_M
    net = stage.network
    pose = start.moved(opens, -2 * LANE_WIDTH_M)
    pose = net.straight("q0", "q1", pose, 55.0, beside)
    net.closed.append(("q0", "q1", 0))
    pose = net.arc("q1", "q2", pose, RAMP_RADIUS_M, -angle, single)
    pose = net.arc("q2", "q3", pose, RAMP_RADIUS_M, angle, single)
    net.straight("q3", "q4", pose, 150.0 + stage.more_m, single)
    ramp: list[LaneIndex] = [(f"q{k}", f"q{k + 1}", 0) for k in range(4)]
    # the ego changes lanes twice, into the ramp
    left, right = main.ahead(0)[0], main.ahead()[0]
    changed = BEFORE_M + first + CHANGE_M
    legs = [
        Leg(left, enter_m=BEFORE_M, leave_m=BEFORE_M + first),
        Leg(right, Command.CHANGE_RIGHT, changed, changed + 10.0),
        Leg(ramp[0], Command.CHANGE_RIGHT, 10.0 + CHANGE_M),
        *(Leg(index) for index in ramp[1:]),
    ]
    stage.drive(legs, start_speed(stage))
    return Ramp(main, ramp, first + CHANGE_M / 2)


def lane_drop(stage: Stage) -> Ramp:
    """Lay a two-lane road whose right lane, the ego's, ends."""
    start, section = origin(stage), Section(2, limit_mps=LIMIT_MPS)
    # the road, with barriers where its right lane ends
    ends = BEFORE_M + stage.place("ends_m", 85.0, 95.0)
    net = stage.network
    after = net.straight("d0", "d1", start, ends, section)
    left = TOTAL_M + stage.more_m - ends
    net.straight("d1", "d2", after, left, replace(section, lanes=1))
    net.closed.append(("d0", "d1", 1))
    block_end(stage, after.moved(0.0, -LANE_WIDTH_M))
    # the ego changes to the left before that
    change = ends - CHANGE_M - 20.0
    legs = [
        Leg(("d0", "d1", 1), enter_m=BEFORE_M, leave_m=change),
        Leg(("d0", "d1", 0), Command.CHANGE_LEFT, change + CHANGE_M),
        Leg(("d1", "d2", 0)),
    ]
    stage.drive(legs, start_speed(stage))
    main = Street((("d0", "d1"), ("d1", "d2")))
    return Ramp(main, [], ends - 30.0 - BEFORE_M)


def four_lanes(stage: Stage) -> Street:
    """Lay four lanes one way, which the ego crosses from the left to the right."""
    section = Section(4, limit_mps=LIMIT_MPS)
    road = lay_road(stage.network, "r", origin(stage), straight(stage), section)
    s, legs = BEFORE_M, list[Leg]()
    stay = stage.place("first_m", 32.0, 38.0)
    for lane in range(4):
        command = Command.CHANGE_RIGHT if lane else Command.FOLLOW
        leave = s + stay if lane < 3 else None
        legs.append(Leg(road.ahead(lane)[0], command, s, leave))
        s += stay + CHANGE_M
        stay = 11.0
    stage.drive(legs, start_speed(stage))
    return road


def block_end(stage: Stage, pose: Pose) -> None:
    """Put barriers where a lane ends."""
    for left in (-0.9, 0.9):
        stage.static_object(ActorKind.BARRIER, pose.moved(1.0, left), (0.5, 1.6, 0.98))


def _beside(stage: Stage, start: Pose, s_m: float) -> float:
    """Return the route arc length beside a point of the main road's right lane."""
    pose = start.moved(s_m, -1.5 * LANE_WIDTH_M)
    return stage.path.project(pose.x, pose.y)[0]
