import math
from dataclasses import replace
from statistics import median

import numpy as np
import pytest

from me2e_compress.evaluators.highway.driven_frames import propose
from me2e_compress.simulator.camera_rig import CLEAR, DRAWN, drawn_weather
from me2e_compress.simulator.routes import SCENARIO_ABILITIES, Route
from me2e_compress.simulator.scenarios.builders import stage_of
from me2e_compress.simulator.scene import Control, EventKind, SignalKind, SignalState
from me2e_compress.simulator.traffic.bodies import Car
from me2e_compress.simulator.traffic.network import Pose
from me2e_compress.simulator.traffic.right_of_way import (
    ALL_RED_S,
    YELLOW_S,
    Regulator,
    SignalPlan,
)
from me2e_compress.simulator.traffic.stage import (
    HORIZON_S,
    TRAFFIC,
    Stage,
    arrival_times,
)
from me2e_compress.simulator.world import World

BRAKE, GO = Control(-8.0, 0.0), Control(1.0, 0.0)
NEAR_M = 80.0


def proposed(scenario: str, seed: int = 3) -> Route:
    return propose(scenario, seed, "test")


@pytest.fixture(scope="module")
def stages() -> dict[str, Stage]:
    return {
        name: stage_of(Route("test", name, number))
        for number, name in enumerate(SCENARIO_ABILITIES)
    }


def moving_near(stage: Stage) -> int:
    x, y = stage.ego.position
    return sum(
        body.speed > 0.3 and math.hypot(*(body.position - (x, y))) < NEAR_M
        for body in stage.bodies
    )


def test_routes_are_200_to_400_m_long_and_begin_among_eight_who_move(
    stages: dict[str, Stage],
) -> None:
    lengths = [stage.path.goal_m for stage in stages.values()]

    assert 200.0 <= min(lengths) < 240.0
    assert 300.0 < max(lengths) <= 400.0
    assert median(map(moving_near, stages.values())) >= 8


def test_every_lane_into_the_map_brings_traffic(stages: dict[str, Stage]) -> None:
    arms = {"T_Junction": 3, "SequentialLaneChange": 4, "EnterActorFlow": 4}
    for name, count in arms.items():
        bodies = (body for _, body in stages[name].schedule.arrivals)
        coming = {body.lanes[0] for body in bodies if isinstance(body, Car)}
        assert len(coming) == count


def test_few_types_wait_for_the_ego_and_the_list_names_them(
    stages: dict[str, Stage],
) -> None:
    waiting = [n for n, stage in stages.items() if "trigger_m" in stage.parameters]

    assert sorted(waiting) == [
        *("CrossingBicycleFlow", "DynamicObjectCrossing", "HardBreakRoute"),
        *("ParkingCrossingPedestrian", "ParkingCutIn", "StaticCutIn"),
        *("VehicleOpensDoorTwoWays", "VehicleTurningRoute"),
        "VehicleTurningRoutePedestrian",
    ]


def test_lights_and_signs_are_met_by_as_many_types_as_promised(
    stages: dict[str, Stage],
) -> None:
    kinds_met = [
        {sign.kind for sign in stage.regulators if sign.line_s is not None}
        for stage in stages.values()
    ]

    assert sum(SignalKind.TRAFFIC_LIGHT in kinds for kinds in kinds_met) >= 12
    signs = {SignalKind.STOP_SIGN, SignalKind.GIVE_WAY}
    assert sum(bool(kinds & signs) for kinds in kinds_met) >= 6


def test_other_traffic_is_other_traffic_on_the_same_road() -> None:
    route = proposed("T_Junction")
    anew = replace(route, parameters={**route.parameters, TRAFFIC: 7})
    one, other = stage_of(route), stage_of(anew)
    first, second = (
        [(time_us, body.id, body.kind) for time_us, body in stage.schedule.arrivals]
        for stage in (one, other)
    )

    assert first != second
    assert {**one.parameters, "traffic": 0} == {**other.parameters, "traffic": 0}
    assert (one.path.points == other.path.points).all()


def seen(route: Route, control: Control, seconds: int) -> list[tuple[object, ...]]:
    """Phases of all lights, and who is there for the first time, every 0.5 s."""
    world, known, rows = World(route), set[int](), list[tuple[object, ...]]()
    for step in range(seconds * 20):
        world.step(control)
        if world.done:
            break
        if step % 10 == 9:
            scene = world.scene()
            new = sorted({actor.id for actor in scene.actors} - known)
            known |= set(new)
            rows.append((*(e.state for e in scene.signals), *new))
    return rows


@pytest.mark.parametrize(
    "scenario", ["VanillaSignalizedTurnEncounterRedLight", "PedestrianCrossing"]
)
def test_standing_changes_neither_lights_nor_arrivals(scenario: str) -> None:
    route = proposed(scenario)
    stands, drives = seen(route, BRAKE, 20), seen(route, GO, 20)

    assert len(stands) == 40
    assert len(drives) > 12
    assert stands[: len(drives)] == drives
    assert len({phases[:1] for phases in stands}) > 1


@pytest.mark.parametrize("offset_s", [0.0, 7.3, 41.0])
def test_a_plan_is_yellow_for_3_s_and_all_red_for_2(offset_s: float) -> None:
    plan = SignalPlan(((), ()), (12.0, 9.0), offset_s)
    phases = [
        tuple(plan.state(group, tenth * 100_000) for group in (0, 1))
        for tenth in range(round(plan.cycle_s * 10))
    ]
    red, yellow = SignalState.RED, SignalState.YELLOW

    assert all(red in both for both in phases)
    assert [sum(e[g] is yellow for e in phases) for g in (0, 1)] == [30, 30]
    assert sum(both == (red, red) for both in phases) == 2 * ALL_RED_S * 10
    assert sum(both[0] is SignalState.GREEN for both in phases) == 120
    assert YELLOW_S == 3.0


def test_a_red_light_stops_traffic_and_green_does_not() -> None:
    world = World(proposed("SignalizedJunctionRightTurn"))
    stopped = 0
    for _ in range(20 * 20):
        world.step(BRAKE)
        if SignalState.RED in {light.state for light in world.scene().signals}:
            cars = (body for body in world.stage.bodies if isinstance(body, Car))
            stopped += sum(car.braking and car.speed < 0.3 for car in cars)

    assert stopped > 50
    assert EventKind.ACTOR_COLLISION not in {event.kind for event in world.events}


def test_gaps_have_their_mean_and_never_fall_below_the_shortest() -> None:
    for platoons in (0.0, 0.5):
        times = [
            time
            for seed in range(60)
            for time in arrival_times(np.random.default_rng(seed), 6.0, 0.0, platoons)
        ]
        one = arrival_times(np.random.default_rng(1), 6.0, -20.0, platoons)
        assert 60 * HORIZON_S / len(times) == pytest.approx(6.0, rel=0.12)
        assert np.diff(one).min() >= 1.6


def test_a_third_of_the_routes_has_weather() -> None:
    kinds = [kind for kind in DRAWN if drawn_weather(kind, 0.5, 1) != CLEAR]

    assert len(kinds) * 3 == len(DRAWN)
    for kind in set(kinds):
        assert drawn_weather(kind, 0.0, 0) != drawn_weather(kind, 1.0, 0)
    night = Route("test", "Accident", 1, {"weather": "night"})

    assert World(night).weather.night > 0.5


LINE_S = 50.0


def regulator(kind: SignalKind, state: SignalState | None = None) -> Regulator:
    return Regulator(1, kind, Pose(0.0, 0.0, 0.0), LINE_S, state)


def drive(
    sign: Regulator, begin: float = 40.0, end: float = 60.0, speed: float = 5.0
) -> list[EventKind]:
    places = np.arange(begin, end + 0.1, 0.25).tolist()
    kinds = [sign.check(at + 2.5, at - 2.5, speed) for at in places]
    return [kind for kind in kinds if kind is not None]


@pytest.mark.parametrize(
    ("before", "after", "fails"),
    [
        (SignalState.RED, SignalState.RED, True),
        (SignalState.YELLOW, SignalState.YELLOW, False),
        (SignalState.GREEN, SignalState.GREEN, False),
        (SignalState.YELLOW, SignalState.RED, True),
        (SignalState.RED, SignalState.GREEN, False),  # waited with the nose over it
    ],
)
def test_red_is_run_by_the_tail_alone_as_in_carla(
    before: SignalState, after: SignalState, fails: bool
) -> None:
    light = regulator(SignalKind.TRAFFIC_LIGHT, before)
    assert drive(light, 40.0, 48.0) == []
    light.state = after

    assert drive(light, 48.0, 60.0) == [EventKind.RED_LIGHT] * fails


@pytest.mark.parametrize(("rest_at", "fails"), [(45.0, False), (35.0, True)])
def test_a_stop_counts_only_near_the_line(rest_at: float, fails: bool) -> None:
    sign = regulator(SignalKind.STOP_SIGN)
    sign.check(rest_at + 2.5, rest_at - 2.5, 0.0)

    assert drive(sign) == [EventKind.STOP_SIGN] * fails


@pytest.mark.parametrize(
    ("seconds", "fails"), [(0.8, True), (3.0, False), (math.inf, False)]
)
def test_giving_way_means_leaving_a_gap(seconds: float, fails: bool) -> None:
    sign = regulator(SignalKind.GIVE_WAY)
    sign.conflict_s, sign.nearest_s = 58.0, lambda: seconds

    assert drive(sign, end=70.0) == [EventKind.GIVE_WAY] * fails


def test_a_signal_off_the_route_is_nobodys_business() -> None:
    light = regulator(SignalKind.TRAFFIC_LIGHT, SignalState.RED)
    light.line_s = None

    assert drive(light) == []


def test_the_stop_line_lies_across_the_lane() -> None:
    sign = Regulator(1, SignalKind.STOP_SIGN, Pose(3.0, 4.0, math.pi / 2), 50.0)

    (x1, y1), (x2, y2) = sign.snapshot().stop_line

    assert (x1, y1) == pytest.approx((1.25, 4.0))
    assert (x2, y2) == pytest.approx((4.75, 4.0))
