"""Scenario types by Bench2Drive's names."""

from collections.abc import Callable

from me2e_compress.simulator.routes import Route
from me2e_compress.simulator.scenarios.types import (
    emergency_brake,
    give_way,
    merging,
    overtaking,
    traffic_signs,
)
from me2e_compress.simulator.traffic.stage import Stage

Builder = Callable[[Stage], None]

BUILDERS: dict[str, Builder] = {
    "Accident": overtaking.accident,
    "AccidentTwoWays": overtaking.accident_two_ways,
    "ConstructionObstacle": overtaking.construction_obstacle,
    "ConstructionObstacleTwoWays": overtaking.construction_obstacle_two_ways,
    "HazardAtSideLane": overtaking.hazard_at_side_lane,
    "HazardAtSideLaneTwoWays": overtaking.hazard_at_side_lane_two_ways,
    "ParkedObstacle": overtaking.parked_obstacle,
    "ParkedObstacleTwoWays": overtaking.parked_obstacle_two_ways,
    "VehicleOpensDoorTwoWays": overtaking.vehicle_opens_door_two_ways,
    "CrossingBicycleFlow": merging.crossing_bicycle_flow,
    "EnterActorFlow": merging.enter_actor_flow,
    "HighwayExit": merging.highway_exit,
    "InterurbanActorFlow": merging.interurban_actor_flow,
    "HighwayCutIn": merging.highway_cut_in,
    "InterurbanAdvancedActorFlow": merging.interurban_advanced_actor_flow,
    "MergerIntoSlowTrafficV2": merging.merger_into_slow_traffic_v2,
    "MergerIntoSlowTraffic": merging.merger_into_slow_traffic,
    "NonSignalizedJunctionLeftTurn": merging.non_signalized_junction_left_turn,
    "NonSignalizedJunctionRightTurn": merging.non_signalized_junction_right_turn,
    "NonSignalizedJunctionLeftTurnEnterFlow": (
        merging.non_signalized_junction_left_turn_enter_flow
    ),
    "ParkingExit": merging.parking_exit,
    "SequentialLaneChange": merging.sequential_lane_change,
    "SignalizedJunctionLeftTurn": merging.signalized_junction_left_turn,
    "SignalizedJunctionRightTurn": merging.signalized_junction_right_turn,
    "SignalizedJunctionLeftTurnEnterFlow": (
        merging.signalized_junction_left_turn_enter_flow
    ),
    "BlockedIntersection": emergency_brake.blocked_intersection,
    "DynamicObjectCrossing": emergency_brake.dynamic_object_crossing,
    "HardBreakRoute": emergency_brake.hard_break_route,
    "OppositeVehicleTakingPriority": emergency_brake.opposite_vehicle_taking_priority,
    "OppositeVehicleRunningRedLight": (
        emergency_brake.opposite_vehicle_running_red_light
    ),
    "ParkingCutIn": emergency_brake.parking_cut_in,
    "PedestrianCrossing": emergency_brake.pedestrian_crossing,
    "ParkingCrossingPedestrian": emergency_brake.parking_crossing_pedestrian,
    "StaticCutIn": emergency_brake.static_cut_in,
    "VehicleTurningRoute": emergency_brake.vehicle_turning_route,
    "VehicleTurningRoutePedestrian": emergency_brake.vehicle_turning_route_pedestrian,
    "ControlLoss": emergency_brake.control_loss,
    "InvadingTurn": give_way.invading_turn,
    "YieldToEmergencyVehicle": give_way.yield_to_emergency_vehicle,
    "T_Junction": traffic_signs.t_junction_turn,
    "VanillaNonSignalizedTurn": traffic_signs.vanilla_non_signalized_turn,
    "VanillaSignalizedTurnEncounterGreenLight": (
        traffic_signs.vanilla_signalized_turn_green
    ),
    "VanillaSignalizedTurnEncounterRedLight": (
        traffic_signs.vanilla_signalized_turn_red
    ),
    "VanillaNonSignalizedTurnEncounterStopsign": (
        traffic_signs.vanilla_non_signalized_turn_stopsign
    ),
}
"""One short function each: a layout and one or two actor scripts."""


def stage_of(route: Route, builder: Builder | None = None) -> Stage:
    """Set up a route: its roads, its actors and their scripts.

    Raises:
        EvaluationError: A parameter of the route is wrong, or not one of its
            scenario's.
    """
    stage = Stage(route)
    (builder or BUILDERS[route.scenario])(stage)
    stage.complete()
    return stage
