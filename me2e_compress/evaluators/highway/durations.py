"""Typical durations of routes, so that long ones start first."""

from collections.abc import Sequence

from me2e_compress.simulator.routes import Route

EXPERT_S = {
    "MergerIntoSlowTrafficV2": 49,
    "MergerIntoSlowTraffic": 40,
    "EnterActorFlow": 34,
    "NonSignalizedJunctionRightTurn": 30,
    "SignalizedJunctionRightTurn": 29,
    "InterurbanAdvancedActorFlow": 28,
    "NonSignalizedJunctionLeftTurnEnterFlow": 27,
    "SignalizedJunctionLeftTurnEnterFlow": 27,
    "T_Junction": 27,
    "VanillaSignalizedTurnEncounterGreenLight": 27,
    "VanillaSignalizedTurnEncounterRedLight": 26,
    "VanillaNonSignalizedTurnEncounterStopsign": 25,
    "ParkingExit": 24,
    "InterurbanActorFlow": 23,
    "SignalizedJunctionLeftTurn": 23,
    "VanillaNonSignalizedTurn": 23,
    "NonSignalizedJunctionLeftTurn": 22,
    "CrossingBicycleFlow": 21,
    "HazardAtSideLaneTwoWays": 21,
    "BlockedIntersection": 20,
    "AccidentTwoWays": 18,
    "SequentialLaneChange": 18,
    "VehicleTurningRoutePedestrian": 18,
    "ConstructionObstacleTwoWays": 17,
    "HighwayExit": 17,
    "VehicleTurningRoute": 17,
    "ParkedObstacleTwoWays": 16,
    "ParkingCrossingPedestrian": 15,
    "YieldToEmergencyVehicle": 15,
    "DynamicObjectCrossing": 14,
    "OppositeVehicleRunningRedLight": 14,
    "OppositeVehicleTakingPriority": 14,
    "InvadingTurn": 13,
    "ParkingCutIn": 13,
    "PedestrianCrossing": 13,
    "StaticCutIn": 13,
    "VehicleOpensDoorTwoWays": 13,
    "Accident": 12,
    "ConstructionObstacle": 12,
    "ControlLoss": 12,
    "HazardAtSideLane": 12,
    "ParkedObstacle": 12,
    "HardBreakRoute": 11,
    "HighwayCutIn": 11,
}
"""Simulated seconds of the expert, mean of the five shipped routes of each type. Only
the order in which routes begin depends on them, never a result."""


def longest_first(routes: Sequence[Route]) -> list[Route]:
    """Order routes by the typical duration of their type, longest first.

    A long route that starts last would keep all other workers waiting.
    """
    return sorted(routes, key=lambda route: (-EXPERT_S[route.scenario], route.id))
