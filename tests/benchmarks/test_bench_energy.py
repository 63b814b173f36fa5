"""Intervals of measured energy hold the truth, on simulated counters."""

import numpy as np
import pytest

from benchmarks.bench_energy import COUNTER, FRAMES_MS, Held, conditions, held
from me2e_compress.runtime.energy.energy_counter import EnergySchedule

SCHEDULE = EnergySchedule(windows=8)


@pytest.fixture(scope="module")
def found() -> list[Held]:
    """Two thousand measurements over the grid, frames of 5 ms left to the script."""
    frames = [frame_ms for frame_ms in FRAMES_MS if frame_ms > 5]
    return [
        held(load, COUNTER, SCHEDULE, simulations=84, seed=seed)
        for seed, (_, _, load) in enumerate(conditions(frames))
    ]


def test_intervals_hold_the_joules_that_were_taken(found: list[Held]) -> None:
    assert sum(each.simulations for each in found) >= 2_000
    assert 0.93 <= np.mean([each.taken for each in found]) <= 0.98


def test_intervals_hold_what_frames_take_on_average(found: list[Held]) -> None:
    assert 0.93 <= np.mean([each.mean for each in found]) <= 0.98


def test_no_condition_is_badly_held(found: list[Held]) -> None:
    assert min(each.taken for each in found) >= 0.87  # 84 of 95 %: 3 deviations


def test_intervals_are_narrow_where_frames_are_out_of_step(found: list[Held]) -> None:
    assert np.median([each.width for each in found]) <= 0.1
