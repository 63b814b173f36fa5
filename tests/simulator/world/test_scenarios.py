import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.metrics.bench2drive import ABILITIES
from me2e_compress.simulator.plane_geometry import (
    Command,
    Lane,
    LaneMarking,
    Roadmap,
    overlaps,
)
from me2e_compress.simulator.routes import (
    EXPERT_S,
    SCENARIO_ABILITIES,
    Route,
    load_routes,
)
from me2e_compress.simulator.scenarios.builders import SCENARIOS, stage_of
from me2e_compress.simulator.world import World
from tests.simulator.world.driving import drive_blind, route_of

TYPES = tuple(SCENARIO_ABILITIES)


def test_there_are_the_44_types_of_bench2drive() -> None:
    sizes = [
        sum(ability in found for found in SCENARIO_ABILITIES.values())
        for ability in ABILITIES
    ]

    assert len(TYPES) == 44
    assert set(SCENARIOS) == set(TYPES) == set(EXPERT_S)
    assert sizes == [9, 16, 12, 2, 19]


@pytest.mark.parametrize("route", load_routes()[::5], ids=lambda route: route.scenario)
def test_who_does_not_look_fails(route: Route) -> None:
    assert any(drive_blind(route, speed) for speed in (12.0, 8.0))


@pytest.mark.parametrize("name", TYPES)
def test_its_route_is_drivable_and_nobody_overlaps_at_the_start(name: str) -> None:
    for seed in range(2):
        world = World(route_of(name, seed))
        path = world.path
        bends = np.abs(np.diff(path.headings))
        steps = np.hypot(*np.diff(path.points, axis=0).T)
        stage = stage_of(route_of(name, seed))
        bodies = [stage.ego, *stage.bodies, *stage.static_objects]
        # people beside the road may begin at one place
        bodies = [body for body in bodies if not getattr(body, "going", False)]

        assert path.length_m >= path.goal_m + 40
        assert bends.max() < 0.12  # a radius of 8.3 m: the ego can turn in 7.6 m
        assert 0.98 < steps.min() <= steps.max() < 1.001
        assert world.roadmap.outside_all(path.points).max() == 0
        boxes = np.array([body.box for body in bodies])
        assert not np.triu(overlaps(boxes[:, None], boxes), 1).any()


@pytest.mark.parametrize("name", ["AccidentTwoWays", "Accident", "ParkingExit"])
def test_the_room_beside_a_route_is_what_the_map_shows(name: str) -> None:
    world = World(route_of(name, 2))
    path = world.path
    for s in range(5, 150, 10):
        for sign, room in ((-1, path.right_m[s]), (1, path.oncoming_m[s])):
            inside = path.at(s, sign * (room - 0.05))
            outside = path.at(s, sign * (room + 0.35))
            assert world.roadmap.outside_m(float(inside[0]), float(inside[1])) == 0
            if room < 8.5:
                far = world.roadmap.outside_m(float(outside[0]), float(outside[1]))
                assert far > 0


PATH = World(route_of("EnterActorFlow", 0, exit="left")).path


@given(st.floats(0.0, 150.0), st.floats(-2.0, 2.0))
def test_projecting_a_point_beside_the_route_finds_it_again(
    s: float, lateral: float
) -> None:
    x, y, _ = PATH.at(s, lateral)

    found_s, found_lateral = PATH.project(float(x), float(y), near_m=s)

    assert found_s == pytest.approx(s, abs=0.15)
    assert found_lateral == pytest.approx(lateral, abs=0.05)


def test_left_is_positive() -> None:
    x, y, heading = PATH.at(10.0)
    left = float(x - np.sin(heading)), float(y + np.cos(heading))
    path = World(route_of("VehicleTurningRoute", 0, move="left")).path
    inside = path.commands == Command.LEFT

    assert PATH.project(*left)[1] == pytest.approx(1.0, abs=1e-6)
    assert path.curvature[inside].max() == pytest.approx(1 / 13.75, rel=0.05)
    assert path.curvature.min() > -0.01


def test_a_turn_is_announced_before_it_begins() -> None:
    path = World(route_of("VehicleTurningRoute", 0, move="right")).path
    first = int(np.argmax(path.commands == Command.RIGHT))
    bends = int(np.argmax(path.curvature < -0.05))

    assert bends - first == pytest.approx(20, abs=2)
    assert path.command_at(float(first) - 1) is Command.FOLLOW


def test_three_lane_changes_are_commanded() -> None:
    commands = World(route_of("SequentialLaneChange", 0)).path.commands
    changes = np.flatnonzero(np.diff(commands) != 0)

    assert Command.CHANGE_RIGHT in commands
    assert len(changes) >= 2
    assert commands[-1] == Command.FOLLOW


@given(st.floats(-30.0, 60.0), st.floats(-20.0, 20.0))
def test_metres_outside_a_straight_lane(x: float, y: float) -> None:
    centre = np.stack([np.arange(0.0, 31.0), np.zeros(31)], axis=1)
    lane = Lane("a>b:0", centre, 4.0, LaneMarking.SOLID, LaneMarking.SOLID)
    beyond = max(-x, x - 30.0, 0.0)

    expected = max(0.0, np.hypot(beyond, y) - 2.0)

    assert Roadmap((lane,)).outside_m(x, y) == pytest.approx(expected, abs=1e-9)
