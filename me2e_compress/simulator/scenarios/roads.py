"""Roads of straights and arcs: parallel lanes, oncoming ones, and shoulders."""

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

from me2e_compress.simulator.plane_geometry import Command, LaneMarking
from me2e_compress.simulator.scene import ActorKind, SignalKind
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Leg,
    Network,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.right_of_way import Regulator, SignalPlan
from me2e_compress.simulator.traffic.stage import GOAL_M, Stage

BEFORE_M = 60.0  # road behind the ego's start, from where others catch up
Edge = tuple[str, str]
BEYOND_M = 120.0  # road beyond the goal
TOTAL_M = BEFORE_M + GOAL_M + BEYOND_M
PARKING_M = 2.5  # width of a parking lane
GREEN_S, WALK_S = (14.0, 24.0), 8.0  # for traffic; for 8 m on foot at 1.2 m/s
LIGHT_M = 125.0  # from the beginning of a conflict to a light, at least
LIMIT_MPS = 14.0  # of fast roads
RAMP_RADIUS_M = 80.0
RAMP_APART_M = 7.0  # sideways from a ramp's straight to the lane it becomes
RAMP_RAD = math.acos(1 - RAMP_APART_M / (2 * RAMP_RADIUS_M))  # of either arc
RAMP = Section(limit_mps=LIMIT_MPS)
BESIDE = replace(RAMP, left=LaneMarking.DASHED)
CHANGE_M = 25.0  # length of a lane change


class Piece(NamedTuple):
    """A straight, or an arc of the leftmost lane."""

    size_m: float  # length of the straight, or radius of the arc
    angle_rad: float = 0.0  # of the arc, positive to the left

    def end(self, pose: Pose) -> Pose:
        """Return the pose at which it ends."""
        if self.angle_rad:
            return pose.along_arc(self.size_m, self.angle_rad)
        return pose.moved(self.size_m)


@dataclass(frozen=True)
class Street:
    """A road; the ego's route begins `BEFORE_M` after the road does."""

    forward: Sequence[Edge]  # in driving direction
    backward: Sequence[Edge] = ()  # oncoming lanes, in their driving direction
    verge: Sequence[Edge] = ()  # the shoulder on the right, in driving direction
    lane: int = 0  # that the ego follows or enters; 0 is the leftmost

    def ahead(self, lane: int | None = None) -> list[LaneIndex]:
        """Return the chain of a forward lane, by default of the ego's."""
        return [(a, b, self.lane if lane is None else lane) for a, b in self.forward]

    def oncoming(self) -> list[LaneIndex]:
        """Return the chain of the oncoming lane."""
        return [(a, b, 0) for a, b in self.backward]

    def shoulder(self) -> list[LaneIndex]:
        """Return the chain of the shoulder or parking lane."""
        return [(a, b, 0) for a, b in self.verge]


def lay_road(
    network: Network,
    name: str,
    start: Pose,
    pieces: Sequence[Piece],
    section: Section,
    oncoming: int = 0,
    shoulder_m: float = 0.0,
) -> Street:
    """Build a road of straights and arcs, joined end to end.

    It begins with its leftmost forward lane at ``start``; ``name`` is the prefix of its
    nodes. Oncoming lanes, left of the forward ones, get the same width and limit. A
    paved shoulder is on the right, and on the other side too of a two-way road.
    """
    width, none = section.width, LaneMarking.NONE
    verge = replace(
        section, lanes=1, width=shoulder_m, left=none, right=none, shoulder=True
    )
    # forward lanes, oncoming lanes, then the shoulders outside them
    centre = LaneMarking.DASHED if oncoming else section.left
    rows = [("f", replace(section, left=centre), 0.0, True)]
    if oncoming:
        opposite = replace(section, lanes=oncoming, left=centre)
        rows.append(("o", opposite, width, False))
    if shoulder_m:
        beside = (section.lanes - 0.5) * width + shoulder_m / 2
        rows.append(("v", verge, -beside, True))
    if shoulder_m and oncoming:
        rows.append(("w", verge, (oncoming + 0.5) * width + shoulder_m / 2, False))
    edges = {
        kind: _lay(network, f"{name}{kind}", start, pieces, lanes, left, forward)
        for kind, lanes, left, forward in rows
    }
    return Street(edges["f"], edges.get("o", [])[::-1], edges.get("v", []))


def _lay(
    network: Network,
    prefix: str,
    start: Pose,
    pieces: Sequence[Piece],
    section: Section,
    left: float,
    forward: bool,
) -> list[Edge]:
    """Lay parallel lanes of one direction, metres ``left`` of the pieces."""
    edges, pose = list[Edge](), start
    for k, piece in enumerate(pieces):
        after = piece.end(pose)
        here, there = f"{prefix}{k}", f"{prefix}{k + 1}"
        # oncoming lanes begin at the far end of the piece
        if forward:
            a, b, begin = here, there, pose.moved(0.0, left)
        else:
            a, b, begin = there, here, after.moved(0.0, left).turned(math.pi)
        # arcs keep their centre: the radius changes with the offset
        if piece.angle_rad:
            radius = piece.size_m - (left if piece.angle_rad > 0 else -left)
            angle = piece.angle_rad if forward else -piece.angle_rad
            network.arc(a, b, begin, radius, angle, section)
        else:
            network.straight(a, b, begin, piece.size_m, section)
        edges.append((a, b))
        pose = after
    return edges


# Roads without junctions: several lanes one way, one lane each way, with parking.


def straight(stage: Stage) -> tuple[Piece, ...]:
    """Return the one piece of a straight road, with road behind and beyond."""
    return (Piece(TOTAL_M + stage.more_m),)


def origin(stage: Stage) -> Pose:
    """Return the pose at which the world begins, with a random heading."""
    return Pose(0.0, 0.0, stage.uniform("heading_rad", -math.pi, math.pi))


def start_speed(stage: Stage) -> float:
    """Return the ego's speed at frame 0 (m/s)."""
    return stage.uniform("speed_mps", 7.0, 10.0)


def street(
    stage: Stage,
    limit_mps: float,
    shoulder_m: float,
    several: bool = False,
    oncoming: int = 0,
    radius_m: tuple[float, float] | None = None,
    light: bool = False,
) -> Street:
    """Lay a road whose lane the ego follows to the goal, with a shoulder.

    It has one lane, or ``several``, of which the ego's is drawn; with a radius there is
    a bend in it. A straight one may have a light.
    """
    lanes, lane = 1, 0
    if several:
        lanes = stage.integer("lanes", 2, 3)
        lane = min(stage.integer("ego_lane", 0, lanes - 1), lanes - 1)
    pieces = straight(stage) if radius_m is None else _curve(stage, *radius_m)
    section, start = Section(lanes, limit_mps=limit_mps), origin(stage)
    road = lay_road(stage.network, "r", start, pieces, section, oncoming, shoulder_m)
    first, *others = road.ahead(lane)
    legs = [Leg(first, enter_m=BEFORE_M), *(Leg(index) for index in others)]
    stage.set_route(legs, start_speed(stage))
    road = replace(road, lane=lane)
    return with_light(stage, road, shoulder_m) if light else road


# A straight one-way road of two or three lanes and a narrow shoulder
multilane = partial(street, limit_mps=14.0, shoulder_m=1.0, several=True)
# A straight one-way road of one lane, without room to overtake
single_lane = partial(street, limit_mps=14.0, shoulder_m=0.5, light=True)
# A one-way road of two or three lanes through a bend
bend = partial(multilane, radius_m=(60.0, 100.0))
one_each_way = partial(street, limit_mps=13.0, shoulder_m=0.6, oncoming=1)
# A straight road, one lane each way; overtaking uses the oncoming lane
two_way = partial(one_each_way, light=True)
# A winding road with one lane each way and a paved shoulder
two_way_bend = partial(
    street, limit_mps=12.0, shoulder_m=1.8, oncoming=1, radius_m=(50.0, 90.0)
)
# A street with one lane each way and a parking lane on either side
parking_street = partial(
    street, limit_mps=12.0, shoulder_m=PARKING_M, oncoming=1, light=True
)


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
    stage.set_route(legs, 2.0)
    return street


def zebra_street(stage: Stage) -> Street:
    """Lay a two-way street with a crosswalk, and lights at it."""
    street = one_each_way(stage)
    s = stage.place("crosswalk_m", 55.0, 80.0)
    return with_light(stage, street, 0.6, s)


def with_light(
    stage: Stage, street: Street, shoulder_m: float, s_m: float | None = None
) -> Street:
    """Put a light for people on foot at a road, at ``s_m`` or else near the goal."""
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
    lights.append(stage.add_regulator(kind, stage.route_pose(at - 3.5)))
    (lane,) = street.ahead()[:1]
    stage.schedule.lines[lane] = [(BEFORE_M + at - 3.5, lights[0])]
    if street.backward:
        line = stage.route_pose(at + 3.5, LANE_WIDTH_M).turned(math.pi)
        lights.append(stage.add_regulator(kind, line))
        (lane,) = street.oncoming()[:1]
        length = stage.network.length(lane)
        stage.schedule.lines[lane] = [(length - BEFORE_M - at - 3.5, lights[1])]
    green = stage.uniform("green_s", *GREEN_S), WALK_S
    plan = SignalPlan((lights, ()), green, 0.0)
    offset = stage.uniform("offset_s", 0.0, plan.cycle_s)
    stage.schedule.plans.append(replace(plan, offset_s=offset))
    return street


def _curve(stage: Stage, tightest: float, widest: float) -> tuple[Piece, ...]:
    radius = stage.uniform("radius_m", tightest, widest)
    side = 1.0 if stage.choice("bend", ("left", "right")) == "left" else -1.0
    before, after = BEFORE_M + 30.0 + stage.lead_m, stage.goal_m - stage.lead_m
    after += BEYOND_M - 90.0
    return Piece(before), Piece(radius, side * (60.0 / radius)), Piece(after)


# Fast roads: an on-ramp, an off-ramp, a lane that ends.


@dataclass(frozen=True)
class Ramp:
    """A fast main road, and the chain of a lane that leads onto it or off it.

    ``main`` names the lane beside the ramp, ``ramp`` includes it, and is empty where a
    lane just ends; at ``merge_s``, arc length, the ego's route changes between the two.
    """

    main: Street
    ramp: list[LaneIndex]
    merge_s: float


def _main_road(stage: Stage, start: Pose) -> Street:
    section = Section(2, limit_mps=LIMIT_MPS)
    road = lay_road(stage.network, "m", start, straight(stage), section)
    return replace(road, lane=1)


def on_ramp(stage: Stage, ego_on_ramp: bool = True) -> Ramp:
    """Lay a ramp that joins from the right and runs beside the main road."""
    start = origin(stage)
    main = _main_road(stage, start)
    # ramp: straight, an S-bend, then the acceleration lane
    apart = -2 * LANE_WIDTH_M - RAMP_APART_M
    net, length = stage.network, BEFORE_M + stage.place("ramp_m", 15.0, 25.0)
    pose = net.straight("p0", "p1", start.moved(0.0, apart), length, RAMP)
    pose = net.arc("p1", "p2", pose, RAMP_RADIUS_M, RAMP_RAD, RAMP)
    pose = net.arc("p2", "p3", pose, RAMP_RADIUS_M, -RAMP_RAD, RAMP)
    lane_m = stage.uniform("acceleration_lane_m", 65.0, 80.0)
    pose = net.straight("p3", "p4", pose, lane_m, BESIDE)
    net.closed.append(("p3", "p4", 0))
    block_end(stage, pose)
    ramp: list[LaneIndex] = [(f"p{k}", f"p{k + 1}", 0) for k in range(4)]
    # the ego's route
    if not ego_on_ramp:
        legs = [Leg(main.ahead()[0], enter_m=BEFORE_M)]
        stage.set_route(legs, start_speed(stage))
        return Ramp(main, ramp, 0.0)
    begun = length + 2 * RAMP_RADIUS_M * math.sin(RAMP_RAD)
    leave = stage.uniform("leave_m", 15.0, 25.0)
    legs = [
        Leg(ramp[0], enter_m=BEFORE_M),
        Leg(ramp[1]),
        Leg(ramp[2]),
        Leg(ramp[3], leave_m=leave),
        Leg(main.ahead()[0], Command.CHANGE_LEFT, begun + leave + CHANGE_M),
    ]
    stage.set_route(legs, start_speed(stage))
    # where the route is beside the middle of the change
    beside_m = start.moved(begun + leave + CHANGE_M / 2, -1.5 * LANE_WIDTH_M)
    return Ramp(main, ramp, stage.path.project(beside_m.x, beside_m.y)[0])


def off_ramp(stage: Stage) -> Ramp:
    """Lay an exit on the right; the ego starts in the left lane of the main road."""
    start = origin(stage)
    main = _main_road(stage, start)
    # ramp: a lane beside the main road, then an S-bend away from it
    first = stage.place("change_m", 40.0, 55.0)
    opens = BEFORE_M + first + CHANGE_M
    net = stage.network
    pose = start.moved(opens, -2 * LANE_WIDTH_M)
    pose = net.straight("q0", "q1", pose, 55.0, BESIDE)
    net.closed.append(("q0", "q1", 0))
    pose = net.arc("q1", "q2", pose, RAMP_RADIUS_M, -RAMP_RAD, RAMP)
    pose = net.arc("q2", "q3", pose, RAMP_RADIUS_M, RAMP_RAD, RAMP)
    net.straight("q3", "q4", pose, 150.0 + stage.more_m, RAMP)
    ramp: list[LaneIndex] = [(f"q{k}", f"q{k + 1}", 0) for k in range(4)]
    # the ego changes lanes twice, into the ramp
    left, right = main.ahead(0)[0], main.ahead()[0]
    legs = [
        Leg(left, enter_m=BEFORE_M, leave_m=BEFORE_M + first),
        Leg(right, Command.CHANGE_RIGHT, opens, opens + 10.0),
        Leg(ramp[0], Command.CHANGE_RIGHT, 10.0 + CHANGE_M),
        *(Leg(index) for index in ramp[1:]),
    ]
    stage.set_route(legs, start_speed(stage))
    return Ramp(main, ramp, first + CHANGE_M / 2)


def lane_drop(stage: Stage) -> Ramp:
    """Lay a two-lane road whose right lane, the ego's, ends."""
    start, section = origin(stage), Section(2, limit_mps=LIMIT_MPS)
    # the road, with barriers where its right lane ends
    ends = BEFORE_M + stage.place("ends_m", 85.0, 95.0)
    net = stage.network
    after = net.straight("d0", "d1", start, ends, section)
    rest_m = TOTAL_M + stage.more_m - ends
    net.straight("d1", "d2", after, rest_m, replace(section, lanes=1))
    net.closed.append(("d0", "d1", 1))
    block_end(stage, after.moved(0.0, -LANE_WIDTH_M))
    # the ego changes to the left before that
    change = ends - CHANGE_M - 20.0
    legs = [
        Leg(("d0", "d1", 1), enter_m=BEFORE_M, leave_m=change),
        Leg(("d0", "d1", 0), Command.CHANGE_LEFT, change + CHANGE_M),
        Leg(("d1", "d2", 0)),
    ]
    stage.set_route(legs, start_speed(stage))
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
    stage.set_route(legs, start_speed(stage))
    return road


def block_end(stage: Stage, pose: Pose) -> None:
    """Put barriers where a lane ends."""
    for left in (-0.9, 0.9):
        stage.add_object(ActorKind.BARRIER, pose.moved(1.0, left), (0.5, 1.6, 0.98))
