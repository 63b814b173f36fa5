"""Junctions of up to four arms, named as the ego sees them."""

import itertools
import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

from me2e_compress.simulator.plane_geometry import Command, LaneMarking
from me2e_compress.simulator.scenarios.roads import origin, start_speed
from me2e_compress.simulator.scene import SignalKind, SignalState
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    PLAIN,
    LaneIndex,
    Leg,
    Network,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.right_of_way import Regulator, SignalPlan
from me2e_compress.simulator.traffic.stage import Stage

ARMS = ("ahead", "left", "back", "right")  # the ego comes from "back"
_TURNS = {"left": Command.LEFT, "right": Command.RIGHT, "ahead": Command.STRAIGHT}
# Half the side of a one-lane junction: a right turn of 10 m radius, which the ego's
# bicycle (7.6 m at full lock) can drive
HALF_M = 12.0
ARM_M = 130.0
SETBACK_M = 3.0  # from the stop line to the junction: room for a crosswalk
GREEN_S = (9.0, 15.0)  # of either group of lights
USUAL_MPS = 9.0  # the speed for which a plan is said to show a driver red or green
# Seconds after green at which the usual driver arrives
FOUND_S = {SignalState.GREEN: (1.0, 6.0), SignalState.RED: (-9.0, -3.0)}
RING_M = 17.0  # radius of the ring lane's centre
RING_WIDTH_M = 4.5
ENTRY_M = 14.0  # radius of the arcs between arms and ring
LIMIT_MPS = 11.0  # on the ring


def _quarters(start: str, end: str) -> int:
    """Return how far one arm is from another: 1 turns right, 2 goes on, 3 left."""
    return (ARMS.index(end) - ARMS.index(start)) % 4


@dataclass(frozen=True)
class Crossing:
    """A finished junction."""

    centre: Pose  # its middle, with the ego's heading as it approaches
    half_m: float  # half its side
    lanes: int  # of each arm, in each direction
    move: str  # the ego's: ahead, left or right
    approach_m: float  # route from the ego's start to the junction's edge
    signals: dict[str, Regulator]  # by arm
    arm_m: float = ARM_M

    def way(self, origin: str, to: str, lane: int = 0) -> list[LaneIndex]:
        """Return the chain of lanes from one arm to another."""
        turn = _quarters(origin, to)
        entry = {1: self.lanes - 1, 2: lane, 3: 0}[turn]
        inside = lane if turn == 2 else 0
        return [
            (f"{origin}.far", f"{origin}.in", entry),
            (f"{origin}.in", f"{to}.out", inside),
            (f"{to}.out", f"{to}.end", entry),
        ]

    def arm(self, name: str, out_m: float, left_m: float = 0.0) -> Pose:
        """Return an outward pose on an arm, beyond its start and left of its middle."""
        angle = ARMS.index(name) * math.pi / 2
        return self.centre.turned(angle).moved(self.half_m + out_m, left_m)


def junction(
    stage: Stage,
    moves: Sequence[str],
    sign: SignalKind | None = None,
    arms: Sequence[str] = ARMS,
    lanes: int = 1,
    limit_mps: float = 13.0,
) -> Crossing:
    """Lay a junction; ``sign`` stands on the ego's arm.

    The ego's move is drawn if there are several ``moves``. Without a sign, traffic from
    its sides gives way.
    """
    minor = ("left", "right") if sign is None else ("back", "ahead")
    crossing = _crossing(stage, moves, arms, lanes, limit_mps, minor)
    if sign is not None:
        line = _stop_line(crossing, "back")
        width = lanes * LANE_WIDTH_M
        crossing.signals["back"] = stage.add_regulator(sign, line, width_m=width)
    return crossing


def signal_junction(
    stage: Stage,
    moves: Sequence[str],
    ego_light: SignalState | None = SignalState.GREEN,
) -> Crossing:
    """Lay a junction with lights; a usual driver finds ``ego_light`` (None: any)."""
    crossing = _crossing(stage, moves, ARMS, 1, 13.0, ())
    for arm in ARMS:
        line = _stop_line(crossing, arm)
        crossing.signals[arm] = stage.add_regulator(SignalKind.TRAFFIC_LIGHT, line)
    # their plan
    lights, schedule = crossing.signals, stage.schedule
    green = (stage.uniform("green_s", *GREEN_S), stage.uniform("cross_s", *GREEN_S))
    groups = (lights["back"], lights["ahead"]), (lights["left"], lights["right"])
    if ego_light is None:
        cycle_s = SignalPlan(groups, green, 0.0).cycle_s
        offset = stage.uniform("offset_s", 0.0, cycle_s)
    else:
        since = stage.uniform("found_s", *FOUND_S[ego_light])
        offset = since - (crossing.approach_m - SETBACK_M) / USUAL_MPS
    schedule.plans.append(SignalPlan(groups, green, offset))
    for arm in ARMS:
        at = crossing.arm_m - SETBACK_M - 1.0
        schedule.lines[f"{arm}.far", f"{arm}.in", 0] = [(at, lights[arm])]
    return crossing


def crosswalk_junction(stage: Stage, moves: Sequence[str]) -> Crossing:
    """Lay a junction with a crosswalk on the arm that the ego turns into."""
    crossing = signal_junction(stage, moves, None)
    half = crossing.lanes * LANE_WIDTH_M
    places = ((0.5, half), (3.5, half), (3.5, -half), (0.5, -half))
    stage.add_crosswalk([crossing.arm(crossing.move, *at) for at in places])
    return crossing


def _stop_line(crossing: Crossing, arm: str) -> Pose:
    """Return the stop line across the incoming lanes, heading inwards."""
    across = crossing.lanes * LANE_WIDTH_M / 2
    return crossing.arm(arm, SETBACK_M + 1.0, across).turned(math.pi)


def _crossing(
    stage: Stage,
    moves: Sequence[str],
    arms: Sequence[str],
    lanes: int,
    limit_mps: float,
    minor: Sequence[str],
) -> Crossing:
    # the junction's size and position
    move = moves[0] if len(moves) == 1 else stage.choice("move", moves)
    approach = stage.place("approach_m", 55.0, 70.0)
    half = HALF_M + (lanes - 1) * LANE_WIDTH_M
    centre = origin(stage).moved(approach + half)
    arm_m = ARM_M + stage.more_m
    crossing = Crossing(centre, half, lanes, move, approach, {}, arm_m)
    section = Section(lanes=lanes, limit_mps=limit_mps)
    # arms, then a connection for each pair
    net = stage.network
    for arm in arms:
        away = crossing.arm(arm, 0.0, -LANE_WIDTH_M / 2)
        net.straight(f"{arm}.out", f"{arm}.end", away, arm_m, section)
        towards = crossing.arm(arm, arm_m, LANE_WIDTH_M / 2).turned(math.pi)
        net.straight(f"{arm}.far", f"{arm}.in", towards, arm_m, section)
    for start, end in itertools.permutations(arms, 2):
        _connect(net, crossing, start, end, limit_mps)
        # straight on before right before left, then minor roads
        rank = {2: 0, 1: 1, 3: 2}[_quarters(start, end)] + (3 if start in minor else 0)
        for lane in range(len(net.graph.graph[f"{start}.in"][f"{end}.out"])):
            net.ranks[f"{start}.in", f"{end}.out", lane] = rank
    # the ego's route
    incoming, inside, outgoing = crossing.way("back", move)
    begin = net.length(incoming) - approach
    legs = [Leg(incoming, enter_m=begin), Leg(inside, _TURNS[move]), Leg(outgoing)]
    stage.set_route(legs, start_speed(stage))
    return crossing


def _connect(
    network: Network, crossing: Crossing, start: str, end: str, limit_mps: float
) -> None:
    lanes = crossing.lanes
    first = crossing.arm(start, 0.0, LANE_WIDTH_M / 2).turned(math.pi)
    here, there = f"{start}.in", f"{end}.out"
    # straight on, right, or left: radii that meet the lanes of the arms
    turn = _quarters(start, end)
    inside = replace(PLAIN, limit_mps=limit_mps)
    if turn == 2:
        through = replace(inside, lanes=lanes, between=LaneMarking.NONE)
        network.straight(here, there, first, 2 * crossing.half_m, through)
    elif turn == 1:
        aside = (lanes - 0.5) * LANE_WIDTH_M
        outer = first.moved(0.0, -(lanes - 1) * LANE_WIDTH_M)
        radius = crossing.half_m - aside
        network.arc(here, there, outer, radius, -math.pi / 2, inside)
    else:
        radius = crossing.half_m + LANE_WIDTH_M / 2
        network.arc(here, there, first, radius, math.pi / 2, inside)


# A roundabout with one ring lane and four arms.


def ring_way(start: str, end: str) -> list[LaneIndex]:
    """Return the chain of lanes from one arm around the ring to another."""
    nodes = [f"{start}.far", f"{start}.in", f"{start}.on"]
    # counter-clockwise past the arms between
    for k in range(1, _quarters(start, end)):
        arm = ARMS[(ARMS.index(start) + k) % 4]
        nodes += [f"{arm}.off", f"{arm}.on"]
    nodes += [f"{end}.off", f"{end}.out", f"{end}.end"]
    return [(a, b, 0) for a, b in itertools.pairwise(nodes)]


def roundabout(stage: Stage) -> Regulator:
    """Lay a roundabout with the ego's route; return the ego's give-way sign."""
    # where the entry arcs touch the ring
    half_lane = LANE_WIDTH_M / 2
    sideways = half_lane + ENTRY_M
    reach = math.sqrt((RING_M + ENTRY_M) ** 2 - sideways**2)
    tangent = math.atan2(sideways, reach)
    approach = stage.place("approach_m", 45.0, 60.0)
    centre = origin(stage).moved(approach + reach)
    for arm in ARMS:
        _circle_arm(stage, centre, arm, reach, tangent)
    # the ego's route around the ring
    to = stage.choice("exit", ("right", "ahead", "left"))
    command = {"right": Command.RIGHT, "ahead": Command.STRAIGHT}.get(to, Command.LEFT)
    incoming, *inside, outgoing = ring_way("back", to)
    begin = stage.network.length(incoming) - approach
    legs = [Leg(incoming, enter_m=begin)]
    legs += [Leg(index, command) for index in inside]
    stage.set_route([*legs, Leg(outgoing)], start_speed(stage))
    # its give-way line
    line = centre.turned(math.pi).moved(reach + 1.0, half_lane)
    return stage.add_regulator(SignalKind.GIVE_WAY, line.turned(math.pi))


def _circle_arm(
    stage: Stage, centre: Pose, name: str, reach: float, tangent: float
) -> None:
    """Lay one arm, its entry and exit arcs, and the ring up to the next arm."""
    net, half_lane = stage.network, LANE_WIDTH_M / 2
    road = Section(limit_mps=LIMIT_MPS + 2.0)
    inside = replace(PLAIN, limit_mps=LIMIT_MPS)
    ring = replace(inside, width=RING_WIDTH_M)
    angle = ARMS.index(name) * math.pi / 2
    out = centre.turned(angle)
    # lanes out and in
    length = ARM_M + stage.more_m
    away, far = out.moved(reach, -half_lane), out.moved(reach + length, half_lane)
    net.straight(f"{name}.out", f"{name}.end", away, length, road)
    towards = net.straight(
        f"{name}.far", f"{name}.in", far.turned(math.pi), length, road
    )
    # entry and exit arcs, and the ring up to the next arm
    turn = math.pi / 2 - tangent
    net.arc(f"{name}.in", f"{name}.on", towards, ENTRY_M, -turn, inside)
    leave = centre.turned(angle - tangent).moved(RING_M).turned(math.pi / 2)
    net.arc(f"{name}.off", f"{name}.out", leave, ENTRY_M, -turn, inside)
    net.arc(f"{name}.off", f"{name}.on", leave, RING_M, 2 * tangent, ring)
    joined = centre.turned(angle + tangent).moved(RING_M).turned(math.pi / 2)
    after = ARMS[(ARMS.index(name) + 1) % len(ARMS)]
    quarter = math.pi / 2 - 2 * tangent
    net.arc(f"{name}.on", f"{after}.off", joined, RING_M, quarter, ring)
    # the ring has priority over who enters
    net.ranks[f"{name}.in", f"{name}.on", 0] = 5
    for lane in ((f"{name}.off", f"{name}.on"), (f"{name}.on", f"{after}.off")):
        net.ranks[(*lane, 0)] = 0
