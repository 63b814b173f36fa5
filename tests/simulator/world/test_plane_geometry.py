import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.simulator.plane_geometry import Command, Lane, LaneMarking, Roadmap
from me2e_compress.simulator.world import World
from tests.simulator.world.driving import route_of

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
