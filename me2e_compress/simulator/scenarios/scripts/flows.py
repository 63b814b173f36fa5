"""Traffic that the ego must give way to, cross or join."""

from dataclasses import replace

from me2e_compress.simulator.scenarios.layouts.crossings import Crossing, ring_way
from me2e_compress.simulator.scenarios.layouts.ramps import Ramp
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    Traffic,
    across,
    encounter,
    keep_clear,
    meeting,
    met,
    stream,
)
from me2e_compress.simulator.scene import ActorKind, Event, EventKind, SignalKind
from me2e_compress.simulator.traffic.cars import Behaviour
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M, LaneIndex
from me2e_compress.simulator.traffic.signals import Regulator
from me2e_compress.simulator.traffic.stage import Script, Stage


def _named_by_routes(stage: Stage) -> None:
    """Draw a parameter that decides nothing: the routes that ship name it."""
    stage.integer("cars", 2, 4)


def oncoming_platoon(stage: Stage, crossing: Crossing) -> Script:
    """Drive oncoming traffic straight on while the ego wants to turn left."""
    _named_by_routes(stage)
    yield from _platoon(stage, crossing.way("ahead", "back"), "oncoming_platoon")


def platoon_from_left(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the left straight into the arm that the ego turns into."""
    _named_by_routes(stage)
    yield from _platoon(stage, crossing.way("left", "right"), "platoon_from_left")


def platoon_to_enter(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the right into the road that the ego turns left into."""
    _named_by_routes(stage)
    chain, sign = crossing.way("right", "left"), crossing.sign
    late = sign is not None and sign.kind is SignalKind.TRAFFIC_LIGHT
    yield from _platoon(stage, chain, "platoon_to_enter", late=late)


def priority_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars, from a random side, that have the right of way."""
    chain = _from_a_side(stage, crossing)
    if crossing.move == "right":
        chain = crossing.way("left", "right")
    yield from _platoon(stage, chain, "priority_car")


def crossing_car(stage: Stage, crossing: Crossing) -> Script:
    """Drive cars from the side that must give way; some do not."""
    yield from _platoon(stage, _from_a_side(stage, crossing), "crossing_car")


def _from_a_side(stage: Stage, crossing: Crossing) -> list[LaneIndex]:
    """Return a chain straight through a junction, from its left or its right."""
    side = stage.choice("from", ("left", "right"))
    return crossing.way(side, "right" if side == "left" else "left")


def flows_from_both_sides(stage: Stage, crossing: Crossing) -> Script:
    """Drive traffic from the left; the background brings some from the right."""
    chain = crossing.way("left", "right", crossing.lanes - 1)
    yield from _platoon(stage, chain, "flows_from_both_sides")


def near_and_far_flow(stage: Stage, crossing: Crossing) -> Script:
    """Drive traffic from the left, in the far lane."""
    yield from _platoon(stage, crossing.way("left", "right", 1), "near_and_far_flow")


def ring_flow(stage: Stage, _: Regulator) -> Script:
    """Circulate cars past the entry at which the ego waits."""
    to = stage.choice("flow_to", ("right", "ahead"))
    _named_by_routes(stage)
    yield from _platoon(stage, ring_way("left", to), "ring_flow")


def exit_lane_flow(stage: Stage, ramp: Ramp) -> Script:
    """Drive dense traffic in the lane that the ego must cross to reach the exit."""
    yield from _beside(stage, ramp.main.ahead(), ramp.merge_s, "exit_lane_flow")


def side_flows(stage: Stage, street: Street) -> Script:
    """Drive dense traffic in the lane of the ego's first change."""
    change = float(stage.parameters["first_m"]) + 12.5
    yield from _beside(stage, street.ahead(1), change, "side_flows")


def bay_flow(stage: Stage, street: Street) -> Script:
    """Drive cars past the parking bay that the ego wants to leave."""
    chain = street.ahead()
    route_s = meeting(stage, chain)
    gap = stage.uniform("bay_flow_gap_s", 3.0, 5.0)
    cars = stream(stage, "bay_flow", [chain], Traffic(gap, (5.0, 7.5), 0.4))
    yield from encounter(stage, cars, route_s, "bay_flow")


def _platoon(
    stage: Stage,
    chain: list[LaneIndex],
    name: str,
    late: bool = False,
) -> Script:
    """Drive traffic on a chain that the ego's route meets; see `across`."""
    yield from across(stage, chain, meeting(stage, chain), name, late=late)


def _beside(stage: Stage, chain: list[LaneIndex], change_s: float, name: str) -> Script:
    """Drive dense traffic in the lane that the ego changes into."""
    yield from across(stage, chain, change_s, name, (2.5, 4.0))


# Lights, signs, and vehicles that take or demand priority.


def red_light(stage: Stage, crossing: Crossing) -> Script:
    """Note that the ego comes to a light that its plan holds red then."""
    line_s = crossing.signals["back"].line_s or crossing.approach_m
    while stage.ahead_m(line_s) > 35.0:
        yield
    stage.fire("red_light")


def stop_sign(stage: Stage, crossing: Crossing) -> Script:
    """Wait for the ego at a stop sign without traffic: only the stop counts."""
    sign = crossing.signals["back"]
    yield from met(stage, sign.line_s or crossing.approach_m, "stop_sign")


INVADING, INTO_M = 0.4, (0.9, 1.2)
"""Share of the oncoming cars that drive partly in the ego's lane,
and how far they reach into it."""
ASIDE_M = 1.1
"""How far right of its lane's centre traffic keeps there, to have room."""


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


SPARSE_S = 20.0
"""Mean gap in the ego's lane where an emergency vehicle comes: others make room."""
HELD_UP_M, HELD_UP_S = 20.0, 4.0
"""The ego has not yielded if the vehicle was this close behind for this long, and still
is behind at the end: it may come too late to be let by."""


def emergency_behind(stage: Stage, street: Street) -> Script:
    """Let an emergency vehicle come from behind that wants to pass.

    It comes from a place that is drawn, and is judged at the end of the route.
    scenario_runner's YieldToEmergencyVehicleTest only asks whether it is ahead then.
    """
    lanes = street.ahead()
    mind = Behaviour(
        3.5, headway_s=0.5, jam_gap_m=4.0, obeys_limits=False, obeys_rules=False
    )
    begin = BEFORE_M - stage.uniform("behind_m", 24.0, 56.0)
    car = stage.car(lanes, begin, 16.0, 20.0, ActorKind.EMERGENCY, mind)
    stream(stage, "same_way", [lanes], Traffic(SPARSE_S))
    held = [0.0]

    def judge() -> Event | None:
        if held[0] < HELD_UP_S or stage.gap_m(car) > 0:
            return None
        return stage.event(EventKind.YIELD_EMERGENCY, "it was held up", car)

    stage.at_goal.append(judge)
    fired = False
    while True:
        yield
        if not -HELD_UP_M < stage.gap_m(car) < 0:
            continue
        held[0] += 0.1
        if not fired:
            fired = True
            stage.fire("emergency_behind", car)
