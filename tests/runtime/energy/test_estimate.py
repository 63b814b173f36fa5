"""The interval is Student's over windows, with what the counter's step allows."""

import math

import numpy as np
import pytest
from scipy import stats

from me2e_compress.runtime.energy.energy_result import Window, estimate, student_t


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
    mean, _, high = estimate(windows(*[100.0] * 5), step_s=0.1)

    # windows of 10 s: 2 ms of a step of 100 ms
    ends = mean / 10.0 * math.sqrt(0.002 * 0.098)
    half = student_t(3) * ends / math.sqrt(5)
    assert high - mean == pytest.approx(half, rel=1e-6)


def test_a_drift_in_a_line_is_no_noise() -> None:
    mean, low, high = estimate(windows(98, 99, 100, 101, 102), step_s=1e-9)

    assert mean == pytest.approx(10.0)
    assert high - low == pytest.approx(0.0, abs=1e-6)


def test_what_is_left_of_the_line_is_the_spread() -> None:
    drawn = np.random.default_rng(0).normal(100, 1, 6)
    _, low, high = estimate(windows(*drawn), step_s=0.1)

    line = stats.linregress(np.arange(6), drawn / 10)
    left = drawn / 10 - line.intercept - line.slope * np.arange(6)
    half = stats.t.ppf(0.975, 4) * math.sqrt(left @ left / 4 / 6)
    assert high - low == pytest.approx(2 * half, rel=1e-3)


def test_windows_that_agree_are_no_better_than_the_step() -> None:
    _, low, high = estimate(windows(*[100.5] * 5, length=10.05), step_s=0.1)

    one = 10.0 * 0.05 / 10  # power x sqrt(r (step - r)), a frame
    half = student_t(3) * one / math.sqrt(5)
    assert high - low == pytest.approx(2 * half)
