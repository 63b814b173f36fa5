"""The 44 scenario types, the abilities they test, and where they differ.

Abilities are those of Bench2Drive (`tools/ability_benchmark.py` of
Thinklab-SJTU/Bench2Drive, branch 0.0.4): a type counts under one ability or under two,
of which the second is Traffic_Signs. Types that `DIFFERENCES` does not name keep the
idea of their namesake in scenario_runner, on our roads.
"""

from me2e_compress.metrics.abilities import TRAFFIC_SIGNS

_BY_ABILITY: dict[str, tuple[str, ...]] = {
    "Overtaking": (
        "Accident",
        "AccidentTwoWays",
        "ConstructionObstacle",
        "ConstructionObstacleTwoWays",
        "HazardAtSideLane",
        "HazardAtSideLaneTwoWays",
        "ParkedObstacle",
        "ParkedObstacleTwoWays",
        "VehicleOpensDoorTwoWays",
    ),
    "Merging": (
        "CrossingBicycleFlow",
        "EnterActorFlow",
        "HighwayExit",
        "InterurbanActorFlow",
        "HighwayCutIn",
        "InterurbanAdvancedActorFlow",
        "MergerIntoSlowTrafficV2",
        "MergerIntoSlowTraffic",
        "NonSignalizedJunctionLeftTurn",
        "NonSignalizedJunctionRightTurn",
        "NonSignalizedJunctionLeftTurnEnterFlow",
        "ParkingExit",
        "SequentialLaneChange",
        "SignalizedJunctionLeftTurn",
        "SignalizedJunctionRightTurn",
        "SignalizedJunctionLeftTurnEnterFlow",
    ),
    "Emergency_Brake": (
        "BlockedIntersection",
        "DynamicObjectCrossing",
        "HardBreakRoute",
        "OppositeVehicleTakingPriority",
        "OppositeVehicleRunningRedLight",
        "ParkingCutIn",
        "PedestrianCrossing",
        "ParkingCrossingPedestrian",
        "StaticCutIn",
        "VehicleTurningRoute",
        "VehicleTurningRoutePedestrian",
        "ControlLoss",
    ),
    "Give_Way": ("InvadingTurn", "YieldToEmergencyVehicle"),
    "Traffic_Signs": (
        "T_Junction",
        "VanillaNonSignalizedTurn",
        "VanillaSignalizedTurnEncounterGreenLight",
        "VanillaSignalizedTurnEncounterRedLight",
        "VanillaNonSignalizedTurnEncounterStopsign",
    ),
}
_ALSO_SIGNS: frozenset[str] = frozenset(
    {
        "CrossingBicycleFlow",
        "EnterActorFlow",
        "NonSignalizedJunctionLeftTurn",
        "NonSignalizedJunctionRightTurn",
        "NonSignalizedJunctionLeftTurnEnterFlow",
        "SignalizedJunctionLeftTurn",
        "SignalizedJunctionRightTurn",
        "SignalizedJunctionLeftTurnEnterFlow",
        "BlockedIntersection",
        "OppositeVehicleTakingPriority",
        "OppositeVehicleRunningRedLight",
        "PedestrianCrossing",
        "VehicleTurningRoute",
        "VehicleTurningRoutePedestrian",
    }
)

SCENARIO_ABILITIES: dict[str, tuple[str, ...]] = {
    scenario: (ability, TRAFFIC_SIGNS) if scenario in _ALSO_SIGNS else (ability,)
    for ability, scenarios in _BY_ABILITY.items()
    for scenario in scenarios
}
"""Scenario type to its one or two abilities, in Bench2Drive's order."""

VARIANTS = 5
"""Routes of each type, as in Bench2Drive's 220."""


DIFFERENCES: dict[str, str] = {
    "ControlLoss": "a slick patch halves the grip before a car that stands across the "
    "lane; noise on the controls, as there, would penalise what no driver did",
    "CrossingBicycleFlow": "the cyclists cross the arm that the ego turns into, on a "
    "path beside the lights, instead of the junction's middle",
    "EnterActorFlow": "the flow that must be entered circulates in a roundabout",
    "HighwayExit": "the flow beside the ego is held level with it until it changes "
    "lanes, so that it is there for every speed",
    "InterurbanAdvancedActorFlow": "out of a side road into four lanes, across the "
    "near flow and into the far one",
    "MergerIntoSlowTrafficV2": "a lane that ends beside the crawling queue; the older "
    "type has an on-ramp",
    "ParkingExit": "as HighwayExit: a car is always level with the ego",
    "SequentialLaneChange": "as HighwayExit, three changes in a row",
    "SignalizedJunctionLeftTurnEnterFlow": "latecomers clear the junction on their "
    "red; there is no turn on red here",
    "SignalizedJunctionRightTurn": "latecomers clear the junction on their red; there "
    "is no right turn on red here",
    "T_Junction": "there a plain turn without traffic; here two flows",
    "VanillaNonSignalizedTurn": "there an empty junction; here a give-way sign and one "
    "car with priority",
    "VanillaSignalizedTurnEncounterGreenLight": "there nothing but the green light; "
    "here a queue that has not noticed it yet",
    "VehicleTurningRoute": "three cyclists in a row instead of one: a car that takes "
    "the turn too fast drifts a lane's width and would miss a single one",
    "VehicleTurningRoutePedestrian": "three pedestrians, for the same reason",
}
"""Scenario type to how it differs from Bench2Drive's type of that name, and why."""
