from itertools import takewhile

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from models.driver.episodes.recording_policy import (
    Perturbation,
    PlanNoise,
    bursts,
)

AHEAD = np.stack([np.arange(3.0, 19.0, 3.0), np.zeros(6)], axis=1)
SEEDS = st.integers(0, 2**32 - 1)


def test_a_drift_grows_with_time() -> None:
    bent = PlanNoise(drift_m=1.2).apply(AHEAD)

    assert bent[:, 0] == pytest.approx(AHEAD[:, 0])
    assert bent[:, 1] == pytest.approx([0.2, 0.4, 0.6, 0.8, 1.0, 1.2])


def test_who_stands_does_not_drift() -> None:
    assert np.all(PlanNoise(drift_m=1.5).apply(np.zeros((6, 2))) == 0.0)


def test_a_turn_goes_to_the_left() -> None:
    bent = PlanNoise(turn_rad=np.pi / 2).apply(AHEAD)

    assert bent == pytest.approx(np.stack([np.zeros(6), AHEAD[:, 0]], axis=1))


def test_a_change_of_speed_keeps_the_way() -> None:
    bent = PlanNoise(speed=0.5).apply(AHEAD)

    assert bent == pytest.approx(AHEAD / 2)


@given(SEEDS)
def test_a_bend_stays_in_its_range(seed: int) -> None:
    noise = PlanNoise.draw(np.random.default_rng(seed), 1.0)

    assert abs(noise.drift_m) <= 1.5
    assert abs(np.rad2deg(noise.turn_rad)) <= 8.0
    assert 0.5 <= noise.speed <= 1.3


@given(SEEDS)
def test_bursts_follow_each_other(seed: int) -> None:
    some = takewhile(lambda b: b.end_us < 60e6, bursts(np.random.default_rng(seed), 1))
    at_us = 0

    for burst in some:
        assert at_us < burst.begin_us
        assert 0.4e6 <= burst.end_us - burst.begin_us + 1 <= 1.5e6 + 2
        at_us = burst.end_us


def test_a_quarter_of_the_time_is_noise() -> None:
    noise = Perturbation(np.random.default_rng(5), 1.0)

    changed = [
        noise.apply(AHEAD, t) is not AHEAD for t in range(0, 2000_000_000, 50_000)
    ]

    assert np.mean(changed) == pytest.approx(0.25, abs=0.03)


def test_all_three_kinds_come() -> None:
    rng = np.random.default_rng(3)
    drawn = [PlanNoise.draw(rng, 1.0) for _ in range(40)]

    assert any(noise.drift_m for noise in drawn)
    assert any(noise.turn_rad for noise in drawn)
    assert any(noise.speed != 1.0 for noise in drawn)


def test_no_strength_is_no_noise() -> None:
    noise = Perturbation(np.random.default_rng(5), 0.0)

    assert all(noise.apply(AHEAD, t) is AHEAD for t in range(0, 100_000_000, 50_000))
