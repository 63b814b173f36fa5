"""The roads and the actors of each scenario type, by Bench2Drive's names."""

from collections.abc import Callable
from functools import partial
from typing import TypeVar

from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.background import populate
from me2e_compress.simulator.scenarios.layouts.circle import roundabout
from me2e_compress.simulator.scenarios.layouts.crossings import (
    crosswalk_junction,
    junction,
    signal_junction,
)
from me2e_compress.simulator.scenarios.layouts.ramps import (
    four_lanes,
    lane_drop,
    off_ramp,
    on_ramp,
)
from me2e_compress.simulator.scenarios.layouts.streets import (
    bend,
    multilane,
    parking_bay,
    parking_street,
    single_lane,
    two_way,
    two_way_bend,
    zebra_street,
)
from me2e_compress.simulator.scenarios.scripts import (
    crossers,
    flows,
    leads,
    obstacles,
    priority,
)
from me2e_compress.simulator.scene import SignalKind, SignalState
from me2e_compress.simulator.traffic.stage import Script, Stage

Builder = Callable[[Stage], None]
Place = TypeVar("Place")


def scenario(
    layout: Callable[[Stage], Place], *scripts: Callable[[Stage, Place], Script]
) -> Builder:
    """Return what lays roads and puts actors on them, in this order."""

    def build(stage: Stage) -> None:
        place = layout(stage)
        for script in scripts:
            stage.play(script(stage, place))

    return build


LEFT, RIGHT, AHEAD = ("left",), ("right",), ("ahead",)
TURNS = ("left", "right")
MOVES = ("left", "right", "ahead")
GIVING_WAY = partial(junction, sign=SignalKind.GIVE_WAY)
"""The ego has a give-way sign; in the types without it, others have, or nobody."""
SIDE_ROAD = partial(GIVING_WAY, arms=("left", "back", "right"))
"""The ego comes out of a side road."""

BUILDERS: dict[str, Builder] = {
    # something stands or crawls in the lane: go round it
    "Accident": scenario(multilane, obstacles.crashed_cars),
    "AccidentTwoWays": scenario(
        two_way, obstacles.crashed_cars, obstacles.oncoming_cars
    ),
    "ConstructionObstacle": scenario(multilane, obstacles.construction),
    "ConstructionObstacleTwoWays": scenario(
        two_way, obstacles.construction, obstacles.oncoming_cars
    ),
    "HazardAtSideLane": scenario(multilane, obstacles.slow_cyclists),
    "HazardAtSideLaneTwoWays": scenario(
        two_way, obstacles.slow_cyclists, obstacles.oncoming_cars
    ),
    "ParkedObstacle": scenario(bend, obstacles.parked_car),
    "ParkedObstacleTwoWays": scenario(
        two_way, obstacles.parked_car, obstacles.oncoming_cars
    ),
    "VehicleOpensDoorTwoWays": scenario(
        parking_street, obstacles.opening_door, obstacles.oncoming_cars
    ),
    # join, cross or leave moving traffic; latecomers may ignore the ego's green
    "CrossingBicycleFlow": scenario(
        partial(signal_junction, moves=TURNS), crossers.bicycle_stream
    ),
    "EnterActorFlow": scenario(roundabout, flows.ring_flow),
    "HighwayExit": scenario(off_ramp, flows.exit_lane_flow),
    "InterurbanActorFlow": scenario(
        partial(junction, moves=LEFT, arms=("ahead", "left", "back"), limit_mps=16.0),
        flows.oncoming_platoon,
    ),
    "HighwayCutIn": scenario(partial(on_ramp, ego_on_ramp=False), leads.ramp_cut_in),
    "InterurbanAdvancedActorFlow": scenario(
        partial(SIDE_ROAD, moves=LEFT, lanes=2, limit_mps=14.0),
        flows.near_and_far_flow,
    ),
    "MergerIntoSlowTrafficV2": scenario(lane_drop, leads.slow_queue),
    "MergerIntoSlowTraffic": scenario(
        partial(on_ramp, ego_on_ramp=True), leads.slow_queue
    ),
    "NonSignalizedJunctionLeftTurn": scenario(
        partial(junction, moves=LEFT), flows.oncoming_platoon
    ),
    "NonSignalizedJunctionRightTurn": scenario(
        partial(GIVING_WAY, moves=RIGHT), flows.platoon_from_left
    ),
    "NonSignalizedJunctionLeftTurnEnterFlow": scenario(
        partial(GIVING_WAY, moves=LEFT), flows.platoon_to_enter
    ),
    "ParkingExit": scenario(parking_bay, flows.bay_flow),
    "SequentialLaneChange": scenario(four_lanes, flows.side_flows),
    "SignalizedJunctionLeftTurn": scenario(
        partial(signal_junction, moves=LEFT), flows.oncoming_platoon
    ),
    "SignalizedJunctionRightTurn": scenario(
        partial(signal_junction, moves=RIGHT), flows.platoon_from_left
    ),
    "SignalizedJunctionLeftTurnEnterFlow": scenario(
        partial(signal_junction, moves=LEFT), flows.platoon_to_enter
    ),
    # another road user appears suddenly
    "BlockedIntersection": scenario(
        partial(junction, moves=MOVES, lights=True), leads.blocked_exit
    ),
    "DynamicObjectCrossing": scenario(two_way, crossers.walker_behind_van),
    "HardBreakRoute": scenario(single_lane, leads.hard_brake),
    "OppositeVehicleTakingPriority": scenario(
        partial(junction, moves=AHEAD), flows.crossing_car
    ),
    "OppositeVehicleRunningRedLight": scenario(
        partial(signal_junction, moves=AHEAD), flows.crossing_car
    ),
    "ParkingCutIn": scenario(parking_street, leads.pull_out),
    "PedestrianCrossing": scenario(zebra_street, crossers.walkers_on_zebra),
    "ParkingCrossingPedestrian": scenario(parking_street, crossers.walker_between_cars),
    "StaticCutIn": scenario(multilane, leads.queue_cut_in),
    "VehicleTurningRoute": scenario(
        partial(junction, moves=TURNS, lights=True), crossers.cyclists_on_exit
    ),
    "VehicleTurningRoutePedestrian": scenario(
        partial(crosswalk_junction, moves=TURNS), crossers.pedestrians_on_exit
    ),
    "ControlLoss": scenario(bend, obstacles.spun_car),
    # make room
    "InvadingTurn": scenario(two_way_bend, priority.invader),
    "YieldToEmergencyVehicle": scenario(multilane, priority.emergency_behind),
    # obey the lights and signs at the junction
    "T_Junction": scenario(
        partial(SIDE_ROAD, moves=TURNS), flows.flows_from_both_sides
    ),
    "VanillaNonSignalizedTurn": scenario(
        partial(GIVING_WAY, moves=TURNS), flows.priority_car
    ),
    "VanillaSignalizedTurnEncounterGreenLight": scenario(
        partial(signal_junction, moves=TURNS), leads.queue_at_light
    ),
    "VanillaSignalizedTurnEncounterRedLight": scenario(
        partial(signal_junction, moves=TURNS, ego_light=SignalState.RED),
        priority.red_light,
    ),
    "VanillaNonSignalizedTurnEncounterStopsign": scenario(
        partial(junction, moves=TURNS, sign=SignalKind.STOP_SIGN), priority.stop_sign
    ),
}


def stage_of(route: Route, builder: Builder | None = None) -> Stage:
    """Set up a route: its roads, its actors and their scripts.

    A ``builder`` of one's own brings its traffic, too.

    Raises:
        EvaluationError: A parameter of the route is wrong, or not one of its
            scenario's.
    """
    stage = Stage(route)
    if builder is None:
        BUILDERS[route.scenario](stage)
        populate(stage)
    else:
        builder(stage)
    stage.schedule.close()
    stage.complete()
    return stage
