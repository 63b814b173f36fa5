"""Lights, signs, and vehicles that take or demand priority."""

from dataclasses import replace

from me2e_compress.simulator.scenarios.layouts.crossings import Crossing
from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M, Street
from me2e_compress.simulator.scenarios.scripts.streams import (
    Traffic,
    encounter,
    stream,
)
from me2e_compress.simulator.scenarios.scripts.synchronise import (
    keep_clear,
    met,
)
from me2e_compress.simulator.scene import ActorKind, Event, EventKind
from me2e_compress.simulator.traffic.cars import Behaviour
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M
from me2e_compress.simulator.traffic.stage import Script, Stage


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
