import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.simulator.traffic.network import (
    LaneTable,
    Network,
    Pose,
    Section,
    flip,
)

angles = st.floats(-3.0, 3.0)
places = st.floats(-50.0, 50.0)


def winding(pose: Pose, radius: float, angle: float) -> Network:
    network = Network()
    section = Section(lanes=2)
    pose = network.straight("a", "b", pose, 40.0, section)
    pose = network.arc("b", "c", pose, radius, angle, section)
    network.straight("c", "d", pose, 40.0, section)
    return network


@given(places, places, angles, st.floats(10.0, 60.0), st.sampled_from([-1.2, 0.9]))
def test_pieces_join_without_a_kink(
    x: float, y: float, heading: float, radius: float, angle: float
) -> None:
    network = winding(Pose(x, y, heading), radius, angle)

    for lane in (0, 1):
        for first, second in ((("a", "b"), ("b", "c")), (("b", "c"), ("c", "d"))):
            here, there = (*first, lane), (*second, lane)
            end = network.pose(here, network.length(here))
            begin = network.pose(there, 0.0)

            assert math.hypot(end.x - begin.x, end.y - begin.y) < 1e-6
            assert math.remainder(end.heading - begin.heading, math.tau) == (
                pytest.approx(0, abs=1e-6)
            )


@given(angles, st.floats(10.0, 60.0))
def test_a_positive_angle_turns_left(heading: float, radius: float) -> None:
    network = Network()
    start = Pose(0.0, 0.0, heading)
    end = network.arc("a", "b", start, radius, math.pi / 2, Section())

    middle = network.pose(("a", "b", 0), network.length(("a", "b", 0)))

    assert (middle.x, middle.y) == pytest.approx((end.x, end.y), abs=1e-6)
    left = start.moved(radius, radius)
    assert (end.x, end.y) == pytest.approx((left.x, left.y), abs=1e-6)


def test_lanes_lie_to_the_right_of_the_first() -> None:
    network = winding(Pose(0.0, 0.0, 0.0), 30.0, 0.9)

    assert network.pose(("a", "b", 1), 10.0).y == pytest.approx(-3.5)
    assert network.length(("b", "c", 1)) == pytest.approx(33.5 * 0.9)


def test_the_rest_of_a_chain_begins_in_the_lane_of_the_arc_length() -> None:
    network = winding(Pose(0.0, 0.0, 0.0), 30.0, 0.9)
    chain = [("a", "b", 0), ("b", "c", 0), ("c", "d", 0)]

    assert network.rest(chain, 39.0) == (chain, 39.0)
    lanes, s_m = network.rest(chain, 45.0)
    assert lanes == chain[1:]
    assert s_m == pytest.approx(5.0)
    assert network.rest(chain[2:], 99.0) == (chain[2:], 99.0)


@given(st.lists(st.tuples(places, places), min_size=1, max_size=8))
def test_the_table_agrees_with_highway_env(points: list[tuple[float, float]]) -> None:
    network = winding(Pose(-20.0, 5.0, 0.4), 25.0, -1.2)
    table = LaneTable(network.graph)
    flipped = np.array([flip(x, y) for x, y in points])

    s, r = table.coordinates(flipped)

    for index, column in table.column.items():
        lane = network.lane(index)
        asked = np.array([lane.local_coordinates(point) for point in flipped])
        np.testing.assert_allclose(s[:, column], asked[:, 0], atol=1e-9)
        np.testing.assert_allclose(r[:, column], asked[:, 1], atol=1e-9)
        headings = np.array([lane.heading_at(value) for value in s[:, column]])
        np.testing.assert_allclose(table.headings(s)[:, column], headings, atol=1e-9)
