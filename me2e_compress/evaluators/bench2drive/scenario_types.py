"""The 44 scenario types of Bench2Drive and the abilities that each tests.

Source: tools/ability_benchmark.py of Bench2Drive 0.0.3 and 0.0.4, which agree.
"""

import re

from me2e_compress.metrics.abilities import ABILITIES, TRAFFIC_SIGNS

_NUMBER = re.compile(r"_\d+$")

_OVERTAKING = """
    Accident AccidentTwoWays ConstructionObstacle ConstructionObstacleTwoWays
    HazardAtSideLane HazardAtSideLaneTwoWays ParkedObstacle ParkedObstacleTwoWays
    VehicleOpensDoorTwoWays
"""
_MERGING = """
    HighwayExit HighwayCutIn InterurbanActorFlow InterurbanAdvancedActorFlow
    MergerIntoSlowTraffic MergerIntoSlowTrafficV2 ParkingExit SequentialLaneChange
"""
_MERGING_AT_SIGNS = """
    CrossingBicycleFlow EnterActorFlow NonSignalizedJunctionLeftTurn
    NonSignalizedJunctionRightTurn NonSignalizedJunctionLeftTurnEnterFlow
    SignalizedJunctionLeftTurn SignalizedJunctionRightTurn
    SignalizedJunctionLeftTurnEnterFlow
"""
_BRAKING = """
    ControlLoss DynamicObjectCrossing HardBreakRoute ParkingCutIn
    ParkingCrossingPedestrian StaticCutIn
"""
_BRAKING_AT_SIGNS = """
    BlockedIntersection OppositeVehicleRunningRedLight OppositeVehicleTakingPriority
    PedestrianCrossing VehicleTurningRoute VehicleTurningRoutePedestrian
"""
_GIVING_WAY = "InvadingTurn YieldToEmergencyVehicle"
_SIGNS = """
    T_Junction VanillaNonSignalizedTurn VanillaNonSignalizedTurnEncounterStopsign
    VanillaSignalizedTurnEncounterGreenLight VanillaSignalizedTurnEncounterRedLight
"""

_TYPES = {
    "Overtaking": _OVERTAKING,
    "Merging": _MERGING + _MERGING_AT_SIGNS,
    "Emergency_Brake": _BRAKING + _BRAKING_AT_SIGNS,
    "Give_Way": _GIVING_WAY,
    TRAFFIC_SIGNS: _SIGNS + _MERGING_AT_SIGNS + _BRAKING_AT_SIGNS,
}
TYPES = {ability: tuple(_TYPES[ability].split()) for ability in ABILITIES}


def type_of(scenario_name: str) -> str:
    """Return the type of a scenario: ``ParkingCutIn`` for ``ParkingCutIn_1``."""
    return _NUMBER.sub("", scenario_name)


def abilities_of(scenario_type: str) -> tuple[str, ...]:
    """Return the abilities that a type tests; none for an unknown type."""
    return tuple(ability for ability in ABILITIES if scenario_type in TYPES[ability])
