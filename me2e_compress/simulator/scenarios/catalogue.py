"""The 44 scenario types: what they test, and how long they take.

Abilities are those of Bench2Drive (`tools/ability_benchmark.py` of
Thinklab-SJTU/Bench2Drive 0.0.3 and 0.0.4, which agree): a type counts under one ability
or under two, of which the second is Traffic_Signs. A type keeps the idea of its
namesake in scenario_runner, on our roads; its layout or script says where it differs.
"""

from me2e_compress.metrics.abilities import TRAFFIC_SIGNS

_TYPES: tuple[tuple[str | int, ...], ...] = (
    ("Accident", 12, "Overtaking"),
    ("AccidentTwoWays", 18, "Overtaking"),
    ("ConstructionObstacle", 12, "Overtaking"),
    ("ConstructionObstacleTwoWays", 17, "Overtaking"),
    ("HazardAtSideLane", 12, "Overtaking"),
    ("HazardAtSideLaneTwoWays", 21, "Overtaking"),
    ("ParkedObstacle", 12, "Overtaking"),
    ("ParkedObstacleTwoWays", 16, "Overtaking"),
    ("VehicleOpensDoorTwoWays", 13, "Overtaking"),
    ("CrossingBicycleFlow", 21, "Merging", TRAFFIC_SIGNS),
    ("EnterActorFlow", 34, "Merging", TRAFFIC_SIGNS),
    ("HighwayExit", 17, "Merging"),
    ("InterurbanActorFlow", 23, "Merging"),
    ("HighwayCutIn", 11, "Merging"),
    ("InterurbanAdvancedActorFlow", 28, "Merging"),
    ("MergerIntoSlowTrafficV2", 49, "Merging"),
    ("MergerIntoSlowTraffic", 40, "Merging"),
    ("NonSignalizedJunctionLeftTurn", 22, "Merging", TRAFFIC_SIGNS),
    ("NonSignalizedJunctionRightTurn", 30, "Merging", TRAFFIC_SIGNS),
    ("NonSignalizedJunctionLeftTurnEnterFlow", 27, "Merging", TRAFFIC_SIGNS),
    ("ParkingExit", 24, "Merging"),
    ("SequentialLaneChange", 18, "Merging"),
    ("SignalizedJunctionLeftTurn", 23, "Merging", TRAFFIC_SIGNS),
    ("SignalizedJunctionRightTurn", 29, "Merging", TRAFFIC_SIGNS),
    ("SignalizedJunctionLeftTurnEnterFlow", 27, "Merging", TRAFFIC_SIGNS),
    ("BlockedIntersection", 20, "Emergency_Brake", TRAFFIC_SIGNS),
    ("DynamicObjectCrossing", 14, "Emergency_Brake"),
    ("HardBreakRoute", 11, "Emergency_Brake"),
    ("OppositeVehicleTakingPriority", 14, "Emergency_Brake", TRAFFIC_SIGNS),
    ("OppositeVehicleRunningRedLight", 14, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ParkingCutIn", 13, "Emergency_Brake"),
    ("PedestrianCrossing", 13, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ParkingCrossingPedestrian", 15, "Emergency_Brake"),
    ("StaticCutIn", 13, "Emergency_Brake"),
    ("VehicleTurningRoute", 17, "Emergency_Brake", TRAFFIC_SIGNS),
    ("VehicleTurningRoutePedestrian", 18, "Emergency_Brake", TRAFFIC_SIGNS),
    ("ControlLoss", 12, "Emergency_Brake"),
    ("InvadingTurn", 13, "Give_Way"),
    ("YieldToEmergencyVehicle", 15, "Give_Way"),
    ("T_Junction", 27, TRAFFIC_SIGNS),
    ("VanillaNonSignalizedTurn", 23, TRAFFIC_SIGNS),
    ("VanillaSignalizedTurnEncounterGreenLight", 27, TRAFFIC_SIGNS),
    ("VanillaSignalizedTurnEncounterRedLight", 26, TRAFFIC_SIGNS),
    ("VanillaNonSignalizedTurnEncounterStopsign", 25, TRAFFIC_SIGNS),
)
"""Name, simulated seconds of the expert (mean of five routes), abilities."""

SCENARIO_ABILITIES: dict[str, tuple[str, ...]] = {
    str(name): tuple(map(str, abilities)) for name, _, *abilities in _TYPES
}
"""Scenario type to its one or two abilities, in Bench2Drive's order."""

EXPERT_S: dict[str, int] = {str(name): int(seconds) for name, seconds, *_ in _TYPES}
"""Scenario type to how long it typically takes. Only the order in which routes begin
and the length of recorded scenes depend on it, never a result."""

VARIANTS = 5
"""Routes of each type, as in Bench2Drive's 220."""
