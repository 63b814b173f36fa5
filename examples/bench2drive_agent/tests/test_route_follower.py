import pytest
from hypothesis import given
from hypothesis import strategies as st

from bench2drive_agent.route_follower import GeoReference, RouteFollower, command_of
from small_leaderboard import LATITUDE, LONGITUDE, gps_of

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


@given(st.floats(10, 8000), metres, metres, st.booleans())
def test_mirrored_latitudes_are_found_out(
    north: float, x: float, other: float, sensor: bool
) -> None:
    plain = GeoReference.through(*gps_of(x, -north), x, north)

    found = plain.as_read(gps_of(x, north if sensor else -north), x, north)

    assert found.mirrored == sensor
    read = found.metres(*gps_of(other, other if sensor else -other))
    assert read == pytest.approx((other, other), abs=1e-4)


def test_a_first_reading_that_fits_nowhere_changes_nothing() -> None:
    found = GeoReference.through(*gps_of(0, -90), 0, 90)

    assert found.as_read(gps_of(300, 50), 0, 90) == found


BEND = [(0, 0, 4), (30, 0, 1), (30, 40, 4), (30, 120, 4)]


def drive(follower: RouteFollower, places: list[tuple[float, float]]) -> list[object]:
    """Return (x, y, command) of what is next at each place."""
    found = [follower.next(x, y) for x, y in places]
    return [(*map(float, near), command) for (near, _), command in found]


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
