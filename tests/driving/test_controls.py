"""Controls as models say them."""

from typing import Any

import numpy as np
import pydantic
import pytest

from me2e_compress.driving.adapter.adapter import ControlAdapter
from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.errors import EvaluationError

AHEAD = (0.0, 30.0)


def straight(speed_mps: float, left: float = 0.0) -> np.ndarray:
    """Waypoints every 0.5 s along one direction."""
    along = 0.5 * speed_mps * np.arange(1, 7)
    return np.stack([along * np.cos(left), along * np.sin(left)], axis=1)


def first(
    plan: np.ndarray,
    speed_mps: float,
    node: tuple[float, float] = AHEAD,
    /,
    **options: float,
) -> PedalsAndWheel:
    asked = PidOptions.model_validate(options)
    return WaypointPid(asked).control(plan, speed_mps, node)


def test_missing_speed_alone_presses_the_throttle() -> None:
    assert first(straight(4.0), 4.0) == PedalsAndWheel(0.0, 0.0, 0.0)
    # 5 x 0.1 + 0.5 x 0.1 / 40 + 1 x 0.1, at most 0.75
    assert first(straight(4.0), 3.9).throttle == pytest.approx(0.60125)
    assert first(straight(4.0), 0.0) == PedalsAndWheel(0.75, 0.0, 0.0)


@pytest.mark.parametrize(
    ("planned_mps", "speed_mps", "brake"),
    [(0.39, 0.0, 1.0), (0.41, 0.0, 0.0), (4.0, 4.39, 0.0), (4.0, 4.41, 1.0)],
)
def test_a_plan_that_is_slow_or_slower_brakes(
    planned_mps: float, speed_mps: float, brake: float
) -> None:
    found = first(straight(planned_mps), speed_mps)

    assert found.brake == brake
    assert not (found.brake and found.throttle)


def test_uniads_agent_coasts_above_its_speed() -> None:
    assert first(straight(9.0), 5.1, coast_above_mps=5.0).throttle == 0.0
    assert first(straight(9.0), 4.9, coast_above_mps=5.0).throttle > 0.0


def test_it_steers_to_the_right_where_the_plan_goes_there() -> None:
    node = (30.0, 30.0)
    quarter = 0.25  # of the way to a right angle
    found = first(straight(4.0, left=-quarter * np.pi / 2), 4.0, node)

    # 0.75 x e + 0.75 x e / 40 + 0.3 x e
    assert found.steer == pytest.approx(quarter * (0.75 + 0.75 / 40 + 0.3))


def test_windows_remember() -> None:
    pid = WaypointPid(PidOptions())
    plan, node = straight(4.0, left=-np.pi / 8), (30.0, 30.0)
    pid.control(plan, 4.0, node)

    # no change since the last: the derivative is gone, the mean has doubled
    assert pid.control(plan, 4.0, node).steer == pytest.approx(0.25 * (0.75 + 1.5 / 40))


def test_it_aims_4_m_ahead_unless_told_otherwise() -> None:
    plan = np.array([[3, 0], [3.9, 0.6], [4.2, 1.6], [6, 3], [8, 4], [10, 5]])
    steers = [first(plan, 4.0, (-20.0, 20.0), aim_m=aim).steer for aim in (3, 4, 5)]

    assert first(plan, 4.0, (-20.0, 20.0)).steer == steers[1]
    assert len(set(steers)) == 3


def test_nodes_are_followed_more_nearly_ahead_or_near_an_outlying_end() -> None:
    near, far = (5.0, 5.0), (15.0, 15.0)

    assert first(straight(4.0, left=-0.4), 4.0, AHEAD).steer == 0.0
    assert first(straight(4.0), 4.0, near).steer > 0.0
    assert first(straight(4.0), 4.0, far).steer == 0.0
    # and steering is limited
    assert first(straight(4.0, left=np.pi / 2), 4.0, (-30.0, 1.0)).steer == -1.0


# Controls as models say them.


def read(control: dict[str, Any], **outputs: Any) -> PedalsAndWheel:
    arrays = {name: np.array(value, np.float32) for name, value in outputs.items()}
    return ControlAdapter.model_validate(control).read(arrays)


THREE = {"throttle": "gas", "steer": "wheel", "brake": "stop"}


PUSHED = {"acceleration": "a[0]", "steer": "a[1]"}
PERCENT = {**THREE, "steer_range": [1.0, 0.0], "throttle_range": [0.0, 100.0]}
"""A sigmoid of steer that is 1 at full left; a throttle in percent."""
BEYOND = {"gas": [1.25], "wheel": [-2.0], "stop": [-0.5]}


@pytest.mark.parametrize(
    ("control", "said", "expected"),
    [
        (THREE, {"gas": [[0.5]], "wheel": [-0.25], "stop": 0.0}, (0.5, -0.25, 0.0)),
        ({"throttle": "c[1]", "steer": "c[0]"}, {"c": [[0.25, 0.5]]}, (0.5, 0.25, 0.0)),
        (PUSHED, {"a": [[0.5, 0.0]]}, (0.5, 0.0, 0.0)),
        (PUSHED, {"a": [[-0.25, 0.0]]}, (0.0, 0.0, 0.25)),  # it brakes below zero
        (PUSHED, {"a": [[0.0, 1.0]]}, (0.0, 1.0, 0.0)),
        (PERCENT, {"gas": [25.0], "wheel": [0.75], "stop": [1.0]}, (0.25, -0.5, 1.0)),
        (THREE, BEYOND, (1.25, -2.0, -0.5)),
        ({**THREE, "clip": True}, BEYOND, (1.0, -1.0, 0.0)),
    ],
)
def test_a_control_is_what_the_outputs_say(
    control: dict[str, Any], said: dict[str, Any], expected: tuple[float, float, float]
) -> None:
    assert read(control, **said) == PedalsAndWheel(*expected)


@pytest.mark.parametrize(
    ("control", "outputs", "message"),
    [
        (THREE, {"gas": [1, 2], "wheel": 0, "stop": 0}, r"gas has 2 .*gas\[0\] for"),
        (
            {"throttle": "gas[2]", "steer": "wheel"},
            {"gas": [1, 2], "wheel": 0},
            r"gas has 2 numbers: there is no gas\[2\]",
        ),
    ],
)
def test_outputs_that_are_no_control(
    control: dict[str, Any], outputs: dict[str, Any], message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        read(control, **outputs)


@pytest.mark.parametrize(
    "control",
    [
        {},
        {"throttle": "a"},
        {"steer": "a"},
        {"acceleration": "a", "steer": "b", "brake": "c"},
        {**THREE, "steer_range": [1.0, 1.0]},
    ],
)
def test_a_control_has_one_form(control: dict[str, Any]) -> None:
    with pytest.raises(pydantic.ValidationError, match=r"either throttle|both ends"):
        ControlAdapter.model_validate(control)
