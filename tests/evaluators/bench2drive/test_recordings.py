import math
from typing import Any

import numpy as np
import pytest

from me2e_compress.evaluators.bench2drive.recordings import (
    BrokenRecordingError,
    read_recording,
)
from me2e_compress.metrics import bench2drive
from me2e_compress.metrics.route_scores import comfort
from tests.evaluators.bench2drive.files import Json, recording
from tests.metrics.drives import drive


def test_a_turn_to_the_right_is_clockwise() -> None:
    read = read_recording(recording(steps=3, yaw_degps=8.0, speed_mps=6.0))

    first, second, _ = read.frames(0.05)

    assert (first.x, first.y, first.time_us, second.time_us) == (0.0, 0.0, 0, 50_000)
    assert first.speed_mps == pytest.approx(6.0, rel=1e-3)
    assert second.y < 0.0 < second.x
    assert second.heading < 0.0
    assert second.yaw_rate_radps == pytest.approx(-math.radians(8.0))
    # the centre of the turn lies to the right: v * omega towards it
    assert second.lateral_acceleration_mps2 == pytest.approx(-6.0 * math.radians(8.0))
    assert second.acceleration_mps2 == pytest.approx(0.0, abs=1e-12)
    assert second.route_m == pytest.approx(0.3, rel=1e-3)
    assert second.steering_rad is None


@pytest.mark.parametrize("interval_s", [0.05, 0.1, 0.5])
def test_the_rate_follows_from_the_motion(interval_s: float) -> None:
    read = read_recording(recording(interval_s=interval_s))

    assert read.interval_s() == interval_s
    # a duration of something else does not decide
    assert read.interval_s(duration_s=1000.0) == interval_s


def brake(interval_s: float) -> Json:
    """Straight ahead from 20 m/s with an acceleration that wavers."""
    raw = recording(steps=80, yaw_degps=0.0)
    times = interval_s * np.arange(80)
    places = 20.0 * times - 2.0 * np.sin(times)
    for step, place, pull in zip(
        raw.values(), places, 2.0 * np.sin(times), strict=True
    ):
        step["location"] = [float(place), 0.0, 0.0]
        step["acceleration"] = [float(pull), 0.0, 9.8]
    return raw


@pytest.mark.parametrize("interval_s", [0.05, 0.1, 0.5])
def test_the_rate_follows_from_braking_alone(interval_s: float) -> None:
    assert read_recording(brake(interval_s)).interval_s() == interval_s


def test_a_duration_decides_at_one_speed() -> None:
    steady = read_recording(recording(steps=40, interval_s=0.5, yaw_degps=0.0))

    assert steady.interval_s(duration_s=40 * 0.5) == 0.5


def test_for_who_stood_the_steps_are_ticks() -> None:
    every_tenth = recording(steps=40, yaw_degps=0.0, speed_mps=0.0, every=10)

    assert read_recording(every_tenth).interval_s(duration_s=40 * 0.1) == 0.5
    assert read_recording(recording(steps=1)).interval_s() == 0.05


def test_degrees_for_radians_and_what_is_right() -> None:
    turn = drive(driven=read_recording(recording()).frames(0.05))

    assert bench2drive.smoothness(turn).value == 0.0
    assert comfort(turn).value == 1.0


def spoilt(part: str, value: object) -> Json:
    raw = recording(steps=4)
    raw["2"][part] = value
    return raw


@pytest.mark.parametrize(
    ("raw", "message"),
    [
        ({}, "no step is recorded"),
        ([], "no step is recorded"),
        ({"begin": {}}, "'begin' is not the number of a step"),
        ({"0": 5}, "step 0: no acceleration"),
        (spoilt("location", [1.0]), "step 2: no location"),
        (spoilt("angular_velocity", None), "step 2: no angular_velocity"),
        (spoilt("acceleration", [0.0, math.nan, 0.0]), "acceleration is not finite"),
        (spoilt("acceleration", [0, 10**400, 0]), "acceleration is not finite"),
        (spoilt("right_vector", ["x", 0, 0]), "right_vector is not made of numbers"),
    ],
)
def test_a_broken_recording_is_one_line(raw: Any, message: str) -> None:
    with pytest.raises(BrokenRecordingError, match=message):
        read_recording(raw)
