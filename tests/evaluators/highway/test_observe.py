import math

import numpy as np
import pytest

from me2e_compress.evaluators.highway.observe import APART_M, RouteNodes
from me2e_compress.simulator.plane_geometry import RoutePath
from me2e_compress.simulator.scene import Ego


def path_of(commands: list[int]) -> RoutePath:
    """Straight to the north, a point every metre."""
    n = len(commands)
    column, heading = np.ones(n), np.full(n, math.pi / 2)
    points = np.stack([np.zeros(n), np.arange(n, dtype=float)], axis=1)
    way = (points, heading, column, column, np.array(commands))
    return RoutePath(*way, n - 1.0, column, column, column)


def ego_at(y: float) -> Ego:
    return Ego(1.0, y, math.pi / 2, 5.0, 0.0, 0.0, 0.0, 0.0, 4.6, 1.9)


NODES = RouteNodes.along(path_of([3] * 70 + [0] * 20 + [3] * 71))


def test_nodes_stand_where_the_command_changes_and_never_far_apart() -> None:
    assert {0.0, 70.0, 90.0, 160.0} <= set(NODES.stations_m)
    assert max(np.diff(NODES.stations_m)) <= APART_M


@pytest.mark.parametrize(
    ("y", "ahead"),
    [(0.0, (35, 70)), (60.0, (10, 30)), (67.0, (23, 58)), (158.0, (2, 2))],
)
def test_the_next_node_lies_at_least_four_metres_ahead_till_the_last(
    y: float, ahead: tuple[float, float]
) -> None:
    """One metre to the left, since the ego is to the right of the path."""
    result = NODES.ahead(y, ego_at(y))

    np.testing.assert_allclose(result, [[metres, 1.0] for metres in ahead], atol=1e-5)
