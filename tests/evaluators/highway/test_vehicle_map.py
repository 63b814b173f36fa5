import pytest

from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.evaluators.highway.controller import control_of, curvature_by
from me2e_compress.simulator.bicycle import MAX_STEERING_RAD, curvature_of

LENGTH_M = 5.0


@pytest.mark.parametrize(
    ("throttle", "brake", "mps2"), [(0.5, 0.0, 2.0), (0.0, 1.0, -8.0), (1.0, 0.5, 0.0)]
)
def test_pedals_span_what_the_ego_can_do(
    throttle: float, brake: float, mps2: float
) -> None:
    found = control_of(PedalsAndWheel(throttle, 0.0, brake), LENGTH_M)

    assert found.acceleration_mps2 == pytest.approx(mps2)
    assert found.steering_rad == 0.0


@pytest.mark.parametrize("steer", [-0.4, 0.05, 0.3])
def test_a_steer_makes_the_same_circle(steer: float) -> None:
    found = control_of(PedalsAndWheel(0.0, steer, 0.0), LENGTH_M)

    assert curvature_of(found.steering_rad, LENGTH_M) == pytest.approx(
        -curvature_by(steer)
    )


def test_the_wheels_turn_no_further() -> None:
    assert curvature_by(1.0) == pytest.approx(1 / 3.72, rel=0.01)
    left = control_of(PedalsAndWheel(0.0, -1.0, 0.0), LENGTH_M)
    assert left.steering_rad == MAX_STEERING_RAD
