"""Traffic that the ego must give way to, cross or join."""

from me2e_compress.simulator.scenarios.layouts.circle import ring_way
from me2e_compress.simulator.scenarios.layouts.crossings import Crossing
from me2e_compress.simulator.scenarios.layouts.ramps import Ramp
from me2e_compress.simulator.scenarios.layouts.road import Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    Traffic,
    across,
    encounter,
    stream,
)
from me2e_compress.simulator.scenarios.scripts.synchronise import meeting
from me2e_compress.simulator.scene import SignalKind
from me2e_compress.simulator.traffic.network import LaneIndex
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
