import math
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.carla.agent_options import (
    conf_parts,
    route_folder,
)
from me2e_compress.evaluators.carla.interface import agents_around
from me2e_compress.evaluators.carla.route_follower import (
    GeoReference,
    RouteFollower,
    command_of,
)
from tests.evaluators.carla.small_leaderboard import (
    LATITUDE,
    LONGITUDE,
    World,
    gps_of,
    written,
)

metres = st.floats(-8000, 8000)


@given(metres, metres, metres, metres)
def test_one_known_place_gives_all_others(
    x: float, y: float, other_x: float, other_y: float
) -> None:
    found = GeoReference.through(*gps_of(x, -y), x, y)

    assert (found.latitude, found.longitude) == pytest.approx((LATITUDE, LONGITUDE))
    assert found.metres(*gps_of(other_x, -other_y)) == pytest.approx(
        (other_x, other_y), abs=1e-4
    )


BEND = [(0, 0, 4), (30, 0, 1), (30, 40, 4), (30, 120, 4)]


def drive(follower: RouteFollower, places: list[tuple[float, float]]) -> list[object]:
    """Return (x, y, command) of what is next at each place."""
    found = [follower.next(x, y) for x, y in places]
    return [(*map(float, place), command) for place, command in found]


def test_a_node_is_next_until_it_is_reached() -> None:
    found = drive(RouteFollower(BEND), [(0, 0), (25, 0), (27, 0), (30, 30), (30, 39)])

    assert found == [
        (30, 0, 0),
        (30, 0, 0),
        (30, 40, 3),
        (30, 40, 3),
        (30, 120, 3),
    ]


def test_the_last_node_stays() -> None:
    places = [(30.0, 0.0), (30.0, 40.0), (30.0, 119.0), (30.0, 200.0)]

    assert drive(RouteFollower(BEND), places)[-1] == (30, 120, 3)


def test_a_node_is_not_given_back() -> None:
    follower = RouteFollower(BEND)

    assert drive(follower, [(29, 0), (0, 0)]) == [(30, 40, 3)] * 2


def test_a_node_that_is_far_along_the_route_is_not_reached() -> None:
    there_and_back = [(0, 0, 4), (40, 0, 4), (80, 0, 4), (40, 1, 4), (0, 1, 4)]

    (found,) = drive(RouteFollower(there_and_back), [(1, 0)])

    assert found == (40, 0, 3)


def test_a_route_of_one_node() -> None:
    assert drive(RouteFollower([(5, 6, 2)]), [(0, 0)]) == [(5, 6, 1)]


@pytest.mark.parametrize(
    ("option", "command"), [(1, 0), (2, 1), (3, 2), (4, 3), (5, 4), (6, 5), (-1, 3)]
)
def test_commands_are_those_of_the_contract(option: int, command: int) -> None:
    assert command_of(option) == command


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -135.0])
def test_places_are_told_in_the_ego_frame(yaw_deg: float) -> None:
    world = World(x=5.0, y=-3.0, yaw_deg=yaw_deg)
    yaw = math.radians(yaw_deg)
    forward = np.array([math.cos(yaw), math.sin(yaw)])
    right = np.array([-math.sin(yaw), math.cos(yaw)])
    world.put("vehicle.audi.tt", *(forward * 12 - right * 2 + (5.0, -3.0)))

    assert agents_around(world.hero) == pytest.approx(np.array([[12.0, 2.0]]))


@pytest.mark.parametrize(
    ("text", "parts"),
    [
        ("a.toml", ("a.toml", "")),
        ("a.toml+Route_1", ("a.toml", "Route_1")),
        ("a.toml+Route_1+Route_2+Route_3", ("a.toml", "Route_3")),
        ("vad.py+vad.pth+Route_1", ("vad.py", "Route_1")),
    ],
)
def test_the_last_field_names_the_route(text: str, parts: tuple[str, str]) -> None:
    path, name = conf_parts(text)

    assert (str(path), name) == parts


def test_a_folder_that_cannot_be_made_is_named(tmp_path: Path) -> None:
    written(tmp_path / "file", "")

    with pytest.raises(EvaluationError, match=r"file/Route_1: cannot be made"):
        route_folder(tmp_path / "file", "Route_1")
