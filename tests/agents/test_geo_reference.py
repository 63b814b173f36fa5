import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.agents.route_follower import GeoReference
from tests.agents.small_leaderboard import LATITUDE, LONGITUDE, gps_of

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


def test_a_map_at_the_equator() -> None:
    found = GeoReference.through(0.001, 0.001, 111.31949, 111.31949)

    assert (found.latitude, found.longitude) == pytest.approx((0, 0), abs=1e-9)
