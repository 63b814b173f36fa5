"""The driver that sees nothing."""

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import CAN_BUS_SIZE, Observation
from me2e_compress.metrics.episode import InfractionKind
from models.driver.expert.blind import SPEEDS_MPS, Blind, centre_plan
from tests.evaluators.highway.tiny_world import circle, ego_at, straight
from tests.simulator.world.driving import drive_blind, route_of


@pytest.mark.parametrize("speed", SPEEDS_MPS)
def test_at_speed_the_waypoints_are_evenly_spaced(speed: float) -> None:
    plan = centre_plan(ego_at(speed=speed), straight(), 5.0, speed)
    np.testing.assert_allclose(plan[:, 0], speed * 0.5 * np.arange(1, 7))
    np.testing.assert_allclose(plan[:, 1], 0.0, atol=1e-9)


def test_it_reaches_its_speed_at_three_metres_a_second_squared() -> None:
    plan = centre_plan(ego_at(speed=5.0), straight(), 5.0, 8.0)
    assert plan[0, 0] == pytest.approx(5.0 * 0.5 + 3.0 * 0.5**2 / 2)
    assert plan[5, 0] == pytest.approx(5.0 + 3.0 / 2 + 8.0 * 2.0)


def test_it_bends_with_the_route() -> None:
    path = circle(12.0, 1.4)
    plan = centre_plan(ego_at(29.0, speed=6.0), path, 29.0, 6.0)
    offsets = [path.project(29.0 + x, y)[1] for x, y in plan]
    assert plan[5, 1] > 8.0
    np.testing.assert_allclose(offsets, 0.0, atol=0.05)


def test_it_drives_into_what_stands_there() -> None:
    faults = drive_blind(route_of("ParkedObstacle", 7), 8.0)
    assert [each.kind for each in faults] == [InfractionKind.COLLISION_VEHICLE]


def test_without_a_world_it_says_what_is_missing() -> None:
    nothing = Observation(
        *(0, None, np.zeros((6, 4, 4), np.float32)),
        can_bus=np.zeros(CAN_BUS_SIZE, np.float32),
        command=3,
        speed_mps=0.0,
    )
    with pytest.raises(EvaluationError, match="blind needs a highway-env world"):
        Blind().plan(nothing)
