"""Labels of who waits in a junction."""

import numpy as np
import pytest

from models.driver.data import BRAKE_MPS2, is_creeping, shortened_to_stop
from models.driver.network.config import STEP_S

TIMES = STEP_S * np.arange(1, 7)
LEFT, FOLLOW = 0, 3


def _rolling(speed_mps: float) -> np.ndarray:
    return np.stack([speed_mps * TIMES, np.zeros(6)], -1)[None]


def _tables(speed_mps: float, command: int) -> dict[str, np.ndarray]:
    bus = np.zeros((1, 18))
    bus[:, 7] = speed_mps
    return {"can_bus": bus, "command": np.array([command])}


@pytest.mark.parametrize(
    ("now_mps", "plan_mps", "alone_mps", "command", "expected"),
    [
        (0.8, 0.8, 4.0, LEFT, True),
        (0.8, 0.8, 4.0, FOLLOW, False),
        (0.8, 0.8, 0.9, LEFT, False),
        (0.8, 3.0, 4.0, LEFT, False),
        (5.0, 0.8, 4.0, LEFT, False),
    ],
    ids=["waits", "in a lane", "nobody there", "sets off", "is fast"],
)
def test_only_waiting_in_a_junction_is_creeping(
    now_mps: float, plan_mps: float, alone_mps: float, command: int, expected: bool
) -> None:
    found = is_creeping(
        _rolling(plan_mps), _tables(now_mps, command), _rolling(alone_mps)
    )
    assert found.tolist() == [expected]


def test_a_stop_brakes_comfortably_and_stays() -> None:
    rng = np.random.default_rng(3)
    speed = rng.uniform(0.2, 2.0, 20)
    turn = rng.uniform(-0.5, 0.5, 20)
    way = speed[:, None, None] * TIMES[:, None]
    plans = way * np.stack([np.cos(turn), np.sin(turn)], -1)[:, None]
    stop = shortened_to_stop(plans, speed)
    length = np.linalg.norm(stop, axis=-1)
    np.testing.assert_allclose(length[:, -1], speed**2 / (2 * BRAKE_MPS2), atol=1e-9)
    assert (np.diff(length, axis=1) > -1e-9).all()
    np.testing.assert_allclose(
        np.arctan2(stop[..., 1], stop[..., 0]), turn[:, None] + 0 * length
    )


def test_a_stop_is_never_longer_than_the_plan() -> None:
    plans = _rolling(0.05)
    assert (shortened_to_stop(plans, np.array([2.0]))[..., 0] <= plans[..., 0]).all()
