"""TCP's fusion: which head leads, and what the other may say."""

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import PedalsAndWheel, Trajectory
from models.tcp.fusion import HeadFusion, Rule

AHEAD = (0.0, 30.0)
TIMES = np.array([0.5, 1.0, 1.5, 2.0])


def straight(speed_mps: float) -> Trajectory:
    return Trajectory(np.outer(TIMES * speed_mps, [1.0, 0.0]), TIMES)


def fused(
    control: PedalsAndWheel, speed_mps: float, rule: Rule = "tcp"
) -> PedalsAndWheel:
    """Fuse with a plan that goes straight at 4 m/s."""
    return HeadFusion(rule).fuse(straight(4.0), control, speed_mps, AHEAD)


def test_the_trajectory_leads_at_first() -> None:
    """At rest its throttle is the most, 0.75."""
    found = fused(PedalsAndWheel(0.25, 0.5, 0.0), 0.0)

    assert found == pytest.approx((0.7 * 0.75 + 0.3 * 0.25, 0.3 * 0.5, 0.0))


def test_the_control_leads_once_it_has_turned_eleven_times() -> None:
    fusion = HeadFusion("tcp")
    control = PedalsAndWheel(0.0, 0.5, 0.0)

    steers = [fusion.fuse(straight(4.0), control, 4.0, AHEAD).steer for _ in range(12)]

    assert steers[:11] == pytest.approx([0.15] * 11)
    assert steers[11] == pytest.approx(0.35)
    fusion.reset()
    assert not fusion.turning


def test_small_steers_are_no_turn() -> None:
    fusion = HeadFusion("tcp")

    for _ in range(20):
        fusion.fuse(straight(4.0), PedalsAndWheel(0.0, 0.33, 0.0), 4.0, AHEAD)

    assert not fusion.turning


def test_the_brake_wins() -> None:
    """The plan is slower than the ego by a half: its brake is full."""
    found = fused(PedalsAndWheel(0.75, 0.0, 0.0), 6.0)

    assert found == pytest.approx((0.0, 0.0, 0.7))


@pytest.mark.parametrize(
    ("control", "speed_mps", "expected"),
    [
        ((0.0, 0.0, 0.1), 0.0, (0.0, 0.0, 1.0)),
        ((0.75, 0.0, 0.0), 0.0, (0.5, 0.0, 0.0)),
        ((0.75, 0.0, 0.0), 1.6, (0.05, 0.0, 0.0)),
        ((0.75, 0.2, 0.0), 1.2, (0.05, 0.1, 0.0)),
    ],
)
def test_bench2drives_agent_creeps(
    control: tuple[float, float, float],
    speed_mps: float,
    expected: tuple[float, float, float],
) -> None:
    found = fused(PedalsAndWheel(*control), speed_mps, "bench2drive")

    assert found == pytest.approx(expected)


def test_one_waypoint_cannot_be_fused() -> None:
    plan = Trajectory(np.ones((1, 2)), np.ones(1))

    with pytest.raises(EvaluationError, match="one waypoint cannot be followed"):
        HeadFusion("tcp").fuse(plan, PedalsAndWheel(0, 0, 0), 1.0, AHEAD)
