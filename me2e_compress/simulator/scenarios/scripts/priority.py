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
    hold,
    keep_clear,
    met,
    nearest_station,
    patience,
)
from me2e_compress.simulator.scene import ActorKind, Event, EventKind, SignalState
from me2e_compress.simulator.traffic.cars import Behaviour
from me2e_compress.simulator.traffic.network import LANE_WIDTH_M, LaneIndex
from me2e_compress.simulator.traffic.stage import Script, Stage

YELLOW_S = 2.0
ALL_RED_S = 1.0
"""Phases of the cross traffic's light before the ego's turns green: our choice."""


def red_light(stage: Stage, crossing: Crossing) -> Script:
    """Keep the light red until the ego has waited; a few cars cross meanwhile.

    On the second road the light follows its plan.
    """
    light = crossing.signals["back"]
    line_s = light.line_s or crossing.approach_m
    ways = (("left", "right"), ("right", "left"))
    if stage.schedule is not None:
        while stage.ahead_m(line_s) > 35.0:
            yield
        stage.fire("red_light")
        return
    # cross traffic
    for k, (start, end) in enumerate(ways):
        chain = crossing.way(start, end)
        away = stage.uniform(f"cross_{k}_m", 15.0, 60.0)
        stage.car(chain, stage.network.length(chain[0]) - away, 8.0, 9.0)
    while stage.ahead_m(line_s) > 35.0:
        yield
    stage.fire("red_light")
    # the ego has waited: the cross traffic's light turns red, the ego's green
    yield from patience(stage, line_s, 12.0)
    for state, seconds in (
        (SignalState.YELLOW, YELLOW_S),
        (SignalState.RED, ALL_RED_S),
    ):
        for arm in ("left", "right"):
            crossing.signals[arm].state = state
        yield from hold(stage, seconds)
    for arm in ("back", "ahead"):
        crossing.signals[arm].state = SignalState.GREEN


def stop_sign(stage: Stage, crossing: Crossing) -> Script:
    """Wait for the ego at a stop sign without traffic: only the stop counts."""
    sign = crossing.signals["back"]
    yield from met(stage, sign.line_s or crossing.approach_m, "stop_sign")


def invader(stage: Stage, street: Street) -> Script:
    """Drive an oncoming car partly in the ego's lane.

    On the second road, a share of the oncoming cars.
    """
    chain = street.oncoming()
    total = sum(stage.network.length(index) for index in chain)
    if stage.schedule is not None:
        yield from _invaders(stage, street)
        return
    where = stage.uniform("meet_m", 55.0, 75.0)
    away = stage.uniform("away_m", 50.0, 60.0)
    kind = ActorKind(stage.choice("invader", ("car", "van")))
    # an oncoming car, offset into the ego's lane
    s = total - (BEFORE_M + where + away)
    car = stage.car(chain, s, 7.0, kind=kind, behaviour=Behaviour(sees_ego=False))
    _, lateral = stage.path.project(car.pose.x, car.pose.y)
    into = stage.uniform("invaded_m", 1.25, 1.45)
    car.offset_m = lateral - into
    # adapt its speed to meet the ego at the chosen place
    begin = stage.route_pose(where)
    station = nearest_station(stage, car.lanes, begin.x, begin.y)
    while stage.arrival_s(where) > 4.0:
        due = stage.ahead_m(where) / max(stage.ego.speed, 2.0)
        wanted = min(max((station - car.station_m) / max(due, 0.2), 2.0), 13.0)
        car.forced_mps2 = min(max((wanted - car.speed) / 0.4, -5.0), 4.0)
        yield
    # hold the offset until they have passed
    stage.fire("invader", car)
    car.forced_mps2, car.target_speed = 0.0, max(car.speed, 4.0)
    while stage.ahead_m(where) > -25.0 and not car.gone:
        pose = car.pose
        if stage.path.project(pose.x, pose.y)[0] < stage.ego_s - 8.0:
            break
        yield
    car.forced_mps2, car.offset_m = None, 0.0


INVADING, INTO_M = 0.4, (0.9, 1.2)
"""Share of the oncoming cars of the second road that drive partly in the ego's lane,
and how far they reach into it."""
ASIDE_M = 1.1
"""How far right of its lane's centre traffic keeps there, to have room."""


def _invaders(stage: Stage, street: Street) -> Script:
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


def emergency_behind(stage: Stage, street: Street) -> Script:
    """Drive an emergency vehicle up from behind that wants to pass.

    Judged as scenario_runner does (YieldToEmergencyVehicleTest): at the end of the
    route it must be ahead of the ego.
    """
    lanes = street.ahead()
    if stage.schedule is not None:
        yield from _emergency_comes(stage, lanes)
        return
    gap = stage.uniform("behind_m", 18.0, 26.0)
    car = stage.car(
        lanes,
        BEFORE_M - gap,
        float(stage.ego.speed) + 5.0,
        18.0,
        ActorKind.EMERGENCY,
        Behaviour(3.5, headway_s=0.5, jam_gap_m=4.0, obeys_limits=False),
    )
    # judged at the end of the route
    passed = [False]

    def judge() -> Event | None:
        if passed[0]:
            return None
        words = "the emergency vehicle is still behind"
        return stage.event(EventKind.YIELD_EMERGENCY, words, car)

    stage.at_goal.append(judge)
    # the event begins when it is close, and ends when it has passed
    while abs(stage.gap_m(car)) > 20.0:
        yield
    stage.fire("emergency_behind", car)
    while stage.gap_m(car) < 0:
        yield
    passed[0] = True


SPARSE_S = 20.0
"""Mean gap in the ego's lane where an emergency vehicle comes: others make room."""
HELD_UP_M, HELD_UP_S = 20.0, 4.0
"""The ego has not yielded if the vehicle was this close behind for this long, and still
is behind at the end: on the second road it may come too late to be let by."""


def _emergency_comes(stage: Stage, lanes: list[LaneIndex]) -> Script:
    """Let an emergency vehicle come from behind, from a place that is drawn."""
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
