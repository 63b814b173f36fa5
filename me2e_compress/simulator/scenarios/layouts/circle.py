"""A roundabout with one ring lane and four arms."""

import math
from dataclasses import replace

from me2e_compress.simulator.plane_geometry import Command
from me2e_compress.simulator.scenarios.layouts.crossings import ARM_M, ARMS
from me2e_compress.simulator.scenarios.layouts.streets import (
    origin,
    start_speed,
)
from me2e_compress.simulator.scene import SignalKind
from me2e_compress.simulator.traffic.legs import Leg
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    PLAIN,
    LaneIndex,
    Pose,
    Section,
)
from me2e_compress.simulator.traffic.signals import Regulator
from me2e_compress.simulator.traffic.stage import Stage

RING_M = 17.0
"""Radius of the ring lane's centre."""
RING_WIDTH_M = 4.5
ENTRY_M = 14.0
"""Radius of the arcs between arms and ring."""
LIMIT_MPS = 11.0


def ring_way(start: str, end: str) -> list[LaneIndex]:
    """Return the chain of lanes from one arm around the ring to another."""
    chain: list[LaneIndex] = [
        (f"{start}.far", f"{start}.in", 0),
        (f"{start}.in", f"{start}.on", 0),
    ]
    arm = start
    while True:
        after = ARMS[(ARMS.index(arm) + 1) % len(ARMS)]
        chain.append((f"{arm}.on", f"{after}.off", 0))
        if after == end:
            break
        chain.append((f"{after}.off", f"{after}.on", 0))
        arm = after
    chain.append((f"{end}.off", f"{end}.out", 0))
    chain.append((f"{end}.out", f"{end}.end", 0))
    return chain


def roundabout(stage: Stage) -> Regulator:
    """Lay the roundabout; the ego leaves it to the right, ahead or to the left.

    Returns the ego's give-way sign.
    """
    # where the entry arcs touch the ring
    half_lane = LANE_WIDTH_M / 2
    sideways = half_lane + ENTRY_M
    reach = math.sqrt((RING_M + ENTRY_M) ** 2 - sideways**2)
    tangent = math.atan2(sideways, reach)
    approach = stage.place("approach_m", 45.0, 60.0)
    centre = origin(stage).moved(approach + reach)
    for arm in ARMS:
        _arm(stage, centre, arm, reach, tangent)
    # the ego's route around the ring
    to = stage.choice("exit", ("right", "ahead", "left"))
    command = {"right": Command.RIGHT, "ahead": Command.STRAIGHT}.get(to, Command.LEFT)
    incoming, *inside, outgoing = ring_way("back", to)
    begin = stage.network.length(incoming) - approach
    legs = [Leg(incoming, enter_m=begin)]
    legs += [Leg(index, command) for index in inside]
    stage.drive([*legs, Leg(outgoing)], start_speed(stage))
    # its give-way line
    line = centre.turned(math.pi).moved(reach + 1.0, half_lane)
    return stage.regulate(SignalKind.GIVE_WAY, line.turned(math.pi))


def _arm(stage: Stage, centre: Pose, name: str, reach: float, tangent: float) -> None:
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
