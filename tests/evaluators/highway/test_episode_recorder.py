"""What of a scene is written down."""

from types import SimpleNamespace
from typing import cast

import numpy as np
import pytest

from me2e_compress.evaluators.highway.episode_recorder import (
    EpisodeRecorder,
    junction_m,
)
from me2e_compress.simulator.plane_geometry import Command, RoutePath
from me2e_compress.simulator.scene import Actor, ActorKind, Scene
from me2e_compress.simulator.world import World
from tests.evaluators.highway.tiny_world import actor, ego_at


def traffic_speed(*actors: Actor) -> float | None:
    """Return the speed of the traffic that a frame keeps; the ego stands at (5, 0)."""
    recorder = EpisodeRecorder(cast(World, SimpleNamespace(progress_m=0.0)))
    recorder.record(Scene(0, ego_at(5.0, 0.0), actors, ()))
    (frame,) = recorder.frames
    return frame.traffic_speed_mps


@pytest.mark.parametrize(
    ("x", "y"), [(7.0, 3.0), (26.0, 0.0), (54.9, 0.0), (-44.9, 0.0), (34.0, 40.0)]
)
def test_vehicles_within_50_m_are_the_traffic(x: float, y: float) -> None:
    assert traffic_speed(actor(x, y, speed=6.0)) == 6.0


@pytest.mark.parametrize(("x", "y"), [(55.1, 0.0), (-45.1, 0.0), (45.0, 40.0)])
def test_vehicles_farther_away_are_not(x: float, y: float) -> None:
    near = actor(40.0, speed=4.0)

    assert traffic_speed(actor(x, y, speed=6.0)) is None
    assert traffic_speed(near, actor(x, y, speed=6.0, number=2)) == 4.0


def test_the_traffic_is_the_mean_of_moving_and_standing_vehicles() -> None:
    near, far = actor(10.0, speed=9.0), actor(50.0, number=2)

    assert traffic_speed(near, far) == 4.5


@pytest.mark.parametrize(
    "kind", [ActorKind.PEDESTRIAN, ActorKind.PARKED, ActorKind.CONE]
)
def test_what_is_no_vehicle_in_traffic_is_left_out(kind: ActorKind) -> None:
    assert traffic_speed(actor(10.0, speed=1.0, kind=kind)) is None


@pytest.mark.parametrize(
    ("commands", "goal_m", "expected"),
    [
        ("FFFLLFFFFF", 9.0, 3 + 20.0),
        ("FFFFRFFFFF", 9.0, 4 + 20.0),
        ("FSFFRFFFFF", 9.0, 1 + 20.0),
        ("FFFCDFFFFF", 9.0, None),
        ("FFFFFFFFLL", 9.0, 8 + 20.0),
        ("FFFFFFFFFL", 9.0, None),
        ("FFFFFFFFFL", 9.5, 9 + 20.0),
    ],
)
def test_a_junction_is_20_m_behind_the_first_turn_that_comes_before_the_goal(
    commands: str, goal_m: float, expected: float | None
) -> None:
    names = {
        "F": Command.FOLLOW,
        "L": Command.LEFT,
        "R": Command.RIGHT,
        "S": Command.STRAIGHT,
        "C": Command.CHANGE_LEFT,
        "D": Command.CHANGE_RIGHT,
    }
    ahead = np.array([names[each] for each in commands], np.int64)
    path = SimpleNamespace(commands=ahead, goal_m=goal_m)

    assert junction_m(cast(RoutePath, path)) == expected
