"""The interval is Student's over windows, with what the counter's step allows."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import stats

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.estimate import (
    BEATS,
    Window,
    beat,
    detuning,
    estimate,
    student_t,
)


def windows(*joules: float, length: float = 10.0) -> list[Window]:
    """Windows of ten frames, one behind the other."""
    return [
        Window(at * length, (at + 1) * length, 10, each)
        for at, each in enumerate(joules)
    ]


@pytest.mark.parametrize("free", [1, 2, 3, 9, 20, 25, 40, 200])
def test_students_t(free: int) -> None:
    assert student_t(free) == pytest.approx(stats.t.ppf(0.975, free), abs=2e-3)


def test_windows_of_whole_steps_are_as_sure_as_the_step_is() -> None:
    found = estimate(windows(*[100.0] * 5), step_s=0.1)

    # windows of 10 s: 2 ms of a step of 100 ms
    ends = found.j_per_frame / 10.0 * math.sqrt(0.002 * 0.098)
    half = student_t(3) * ends / math.sqrt(5)
    assert found.high - found.j_per_frame == pytest.approx(half, rel=1e-6)


def test_a_drift_in_a_line_is_no_noise() -> None:
    found = estimate(windows(98, 99, 100, 101, 102), step_s=1e-9)

    assert found.j_per_frame == pytest.approx(10.0)
    assert found.high - found.low == pytest.approx(0.0, abs=1e-6)


def test_what_is_left_of_the_line_is_the_spread() -> None:
    drawn = np.random.default_rng(0).normal(100, 1, 6)
    found = estimate(windows(*drawn), step_s=0.1)

    line = stats.linregress(np.arange(6), drawn / 10)
    left = drawn / 10 - line.intercept - line.slope * np.arange(6)
    half = stats.t.ppf(0.975, 4) * math.sqrt(left @ left / 4 / 6)
    assert found.high - found.low == pytest.approx(2 * half, rel=1e-3)


def test_windows_that_agree_are_no_better_than_the_step() -> None:
    found = estimate(windows(*[100.5] * 5, length=10.05), step_s=0.1)

    one = 10.0 * 0.05 / 10  # power x sqrt(r (step - r)), a frame
    half = student_t(3) * one / math.sqrt(5)
    assert found.high - found.low == pytest.approx(2 * half)


def test_pauses_are_taken_off_and_added_to_the_interval() -> None:
    paused = [replace(each, paused_s=0.2) for each in windows(*[100.0] * 5)]
    found = estimate(paused, step_s=1e-9, idle_w=6.0)

    assert found.j_per_frame == pytest.approx((100 - 0.2 * 8) / 10)
    assert found.high - found.low == pytest.approx(2 * 0.2 * 2 / 10, rel=1e-6)


def test_too_few_windows() -> None:
    with pytest.raises(EnergyError, match="4 windows: at least 5 are needed"):
        estimate(windows(1, 1, 1, 1), step_s=0.1)


@pytest.mark.parametrize("frame_ms", [20, 25.1, 50, 100, 150, 200, 400])
def test_no_frame_keeps_step_once_it_is_held_up(frame_ms: float) -> None:
    pause = detuning(frame_ms / 1e3, 100, 0.1)

    assert beat(frame_ms / 1e3 + pause, 100, 0.1) < BEATS
    assert 0 <= pause <= 1e-3


@pytest.mark.parametrize(("frame_ms", "found"), [(100, 0.9), (200, 0.9), (50, 0.64)])
def test_frames_that_keep_step_are_seen(frame_ms: float, found: float) -> None:
    assert beat(frame_ms / 1e3, 100, 0.1) == pytest.approx(found, abs=0.01)


@given(
    frame_s=st.floats(1e-4, 1.0),
    frames=st.integers(100, 5_000),
    step_s=st.sampled_from([1e-3, 0.02, 0.1]),
)
def test_holding_up_never_makes_it_worse(
    frame_s: float, frames: int, step_s: float
) -> None:
    pause = detuning(frame_s, frames, step_s)

    assert 0 <= pause <= step_s / frames
    assert beat(frame_s + pause, frames, step_s) <= max(
        BEATS, beat(frame_s, frames, step_s)
    )
