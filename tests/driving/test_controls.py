"""Controls as models say them."""

from typing import Any

import numpy as np
import pydantic
import pytest

from me2e_compress.driving.adapter.adapter import ControlAdapter
from me2e_compress.driving.contract import PedalsAndWheel
from me2e_compress.errors import EvaluationError


def read(control: dict[str, Any], **outputs: Any) -> PedalsAndWheel:
    arrays = {name: np.array(value, np.float32) for name, value in outputs.items()}
    return ControlAdapter.model_validate(control).read(arrays)


THREE = {"throttle": "gas", "steer": "wheel", "brake": "stop"}


def test_three_outputs_or_one_vector() -> None:
    found = read(THREE, gas=[[0.5]], wheel=[-0.25], stop=0.0)
    control = {"throttle": "c[1]", "steer": "c[0]"}

    assert found == PedalsAndWheel(0.5, -0.25, 0.0)
    assert read(control, c=[[0.25, 0.5]]) == PedalsAndWheel(0.5, 0.25, 0.0)


@pytest.mark.parametrize(
    ("said", "expected"),
    [
        ([0.5, 0.0], PedalsAndWheel(0.5, 0.0, 0.0)),
        ([-0.25, 0.0], PedalsAndWheel(0.0, 0.0, 0.25)),
        ([0.0, 1.0], PedalsAndWheel(0.0, 1.0, 0.0)),
    ],
)
def test_an_acceleration_brakes_below_zero(
    said: list[float], expected: PedalsAndWheel
) -> None:
    control = {"acceleration": "a[0]", "steer": "a[1]"}

    assert read(control, a=[said]) == expected


def test_ranges_are_what_the_model_says_at_their_ends() -> None:
    """A sigmoid of steer that is 1 at full left; a throttle in percent."""
    control = {**THREE, "steer_range": [1.0, 0.0], "throttle_range": [0.0, 100.0]}

    found = read(control, gas=[25.0], wheel=[0.75], stop=[1.0])

    assert found == PedalsAndWheel(0.25, -0.5, 1.0)


def test_what_is_beyond_its_range_is_clipped_only_if_asked() -> None:
    said = {"gas": [1.25], "wheel": [-2.0], "stop": [-0.5]}

    assert read(THREE, **said) == PedalsAndWheel(1.25, -2.0, -0.5)
    assert read({**THREE, "clip": True}, **said) == PedalsAndWheel(1.0, -1.0, 0.0)


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
