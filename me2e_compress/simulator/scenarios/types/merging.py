"""Merging: join, cross or leave moving traffic."""

from me2e_compress.simulator.scenarios.layouts.circle import roundabout
from me2e_compress.simulator.scenarios.layouts.crossings import (
    interurban_entry,
    interurban_turnoff,
    junction,
    signal_junction,
)
from me2e_compress.simulator.scenarios.layouts.ramps import (
    four_lanes,
    lane_drop,
    off_ramp,
    on_ramp,
)
from me2e_compress.simulator.scenarios.layouts.streets import parking_bay
from me2e_compress.simulator.scenarios.scripts.crossers import bicycle_stream
from me2e_compress.simulator.scenarios.scripts.flows import (
    bay_flow,
    exit_lane_flow,
    near_and_far_flow,
    oncoming_platoon,
    platoon_from_left,
    platoon_to_enter,
    ring_flow,
    side_flows,
)
from me2e_compress.simulator.scenarios.scripts.leads import (
    ramp_cut_in,
    slow_queue,
)
from me2e_compress.simulator.scene import SignalKind
from me2e_compress.simulator.traffic.stage import Stage


def crossing_bicycle_flow(stage: Stage) -> None:
    """Turn, at a green light, across a stream of cyclists."""
    crossing = signal_junction(stage, stage.choice("move", ("left", "right")))
    stage.play(bicycle_stream(stage, crossing))


def enter_actor_flow(stage: Stage) -> None:
    """Enter a roundabout whose ring is busy.

    Bench2Drive's type is a flow of cars that the ego must enter; a ring is ours.
    """
    stage.play(ring_flow(stage, roundabout(stage)))


def highway_exit(stage: Stage) -> None:
    """Cross an occupied lane to reach an exit."""
    stage.play(exit_lane_flow(stage, off_ramp(stage)))


def interurban_actor_flow(stage: Stage) -> None:
    """Turn off a fast road across oncoming traffic."""
    stage.play(oncoming_platoon(stage, interurban_turnoff(stage)))


def highway_cut_in(stage: Stage) -> None:
    """A car from an on-ramp cuts in."""
    stage.play(ramp_cut_in(stage, on_ramp(stage, ego_on_ramp=False)))


def interurban_advanced_actor_flow(stage: Stage) -> None:
    """Turn left into a four-lane road: cross one flow, join the other."""
    stage.play(near_and_far_flow(stage, interurban_entry(stage)))


def merger_into_slow_traffic_v2(stage: Stage) -> None:
    """The ego's lane ends beside a crawling queue."""
    street = lane_drop(stage)
    merge = street.start_m + float(stage.parameters["ends_m"]) - 30.0
    stage.play(slow_queue(stage, [("d0", "d1", 0), ("d1", "d2", 0)], merge))


def merger_into_slow_traffic(stage: Stage) -> None:
    """An on-ramp joins a crawling queue."""
    ramp = on_ramp(stage, ego_on_ramp=True)
    merge = 60.0 + ramp.merge_s
    stage.play(slow_queue(stage, ramp.main.ahead(1), merge))


def non_signalized_junction_left_turn(stage: Stage) -> None:
    """Turn left across oncoming traffic."""
    stage.play(oncoming_platoon(stage, junction(stage, "left")))


def non_signalized_junction_right_turn(stage: Stage) -> None:
    """Turn right, giving way to traffic from the left."""
    crossing = junction(stage, "right", SignalKind.GIVE_WAY)
    stage.play(platoon_from_left(stage, crossing))


def non_signalized_junction_left_turn_enter_flow(stage: Stage) -> None:
    """Turn left into traffic that comes from the right."""
    crossing = junction(stage, "left", SignalKind.GIVE_WAY)
    stage.play(platoon_to_enter(stage, crossing))


def parking_exit(stage: Stage) -> None:
    """Leave a parking bay while traffic passes."""
    stage.play(bay_flow(stage, parking_bay(stage)))


def sequential_lane_change(stage: Stage) -> None:
    """Three lane changes in a row, with cars beside."""
    stage.play(side_flows(stage, four_lanes(stage)))


def signalized_junction_left_turn(stage: Stage) -> None:
    """Turn left on green across oncoming traffic, which has green too."""
    stage.play(oncoming_platoon(stage, signal_junction(stage, "left")))


def signalized_junction_right_turn(stage: Stage) -> None:
    """Turn right on a green that latecomers from the left ignore."""
    stage.play(platoon_from_left(stage, signal_junction(stage, "right")))


def signalized_junction_left_turn_enter_flow(stage: Stage) -> None:
    """Turn left on a green that latecomers from the right ignore."""
    stage.play(platoon_to_enter(stage, signal_junction(stage, "left")))
