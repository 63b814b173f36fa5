"""Where a type is not Bench2Drive's but its relative, and why.

The other types keep the idea of their namesake in scenario_runner, on our roads.
"""

RELATIVES: dict[str, str] = {
    "ControlLoss": "a slick patch halves the grip before a car that stands across the "
    "lane; noise on the controls, as there, would punish a driver for the simulator",
    "CrossingBicycleFlow": "the cyclists cross the arm that the ego turns into, on a "
    "path beside the lights, instead of the junction's middle",
    "EnterActorFlow": "the flow that must be entered circulates in a roundabout",
    "HighwayExit": "the flow beside the ego is held level with it until it changes "
    "lanes, so that it is there for every speed",
    "InterurbanAdvancedActorFlow": "out of a side road into four lanes, across the "
    "near flow and into the far one",
    "MergerIntoSlowTrafficV2": "a lane that ends beside the crawling queue; the older "
    "type has an on-ramp",
    "ParkingExit": "as HighwayExit: somebody is always level with the ego",
    "SequentialLaneChange": "as HighwayExit, three changes in a row",
    "SignalizedJunctionLeftTurnEnterFlow": "latecomers clear the junction on their "
    "red; there is no turn on red here",
    "SignalizedJunctionRightTurn": "latecomers clear the junction on their red; there "
    "is no right turn on red here",
    "T_Junction": "there a plain turn, which a blind driver survives; here two flows",
    "VanillaNonSignalizedTurn": "there an empty junction; here a give-way sign and one "
    "car with priority",
    "VanillaSignalizedTurnEncounterGreenLight": "there nothing but the green light; "
    "here a queue that has not noticed it yet",
    "VehicleTurningRoute": "three cyclists in a row instead of one: whoever takes the "
    "turn too fast drifts a lane's width and would miss a single one",
    "VehicleTurningRoutePedestrian": "three pedestrians, for the same reason",
}
"""Scenario type to what is different here."""
