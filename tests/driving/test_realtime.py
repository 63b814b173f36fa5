from collections.abc import Callable
from fractions import Fraction
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.driving.realtime import (
    HeldControl,
    LatencyModel,
    PipelinedControl,
    control_clock,
    delayed_frames,
    skipped_decisions,
)
from me2e_compress.errors import EvaluationError

latencies = st.lists(st.integers(0, 600_000), min_size=1, max_size=12)
steps = st.sampled_from([50_000, 25_000, 10_000])


@pytest.mark.parametrize(
    ("latency_us", "skipped"),
    [
        *((0, 0), (49_999, 0), (50_000, 0), (99_999, 0), (100_000, 1), (130_000, 1)),
        *((149_999, 1), (150_000, 2), (250_000, 4), (850_000, 16)),
    ],
)
def test_equation_4_at_20_hz(latency_us: int, skipped: int) -> None:
    assert skipped_decisions(latency_us) == skipped


@given(st.integers(0, 5_000_000), steps)
def test_equation_4_in_exact_fractions(latency_us: int, dt_us: int) -> None:
    seconds, dt = Fraction(latency_us, 10**6), Fraction(dt_us, 10**6)

    assert skipped_decisions(latency_us, dt_us) == max(0, int(seconds / dt) - 1)


def by_the_text(latencies_us: list[int], dt_us: int) -> tuple[list[int], list[int]]:
    """Decision d is number d, the initial control -1: (acting, deciding) frames.

    Written frame by frame from the rule: the control in force before frame k stays
    for k .. k + n, the new one acts from k + n + 1, where the next is decided; with
    n = 0 it acts at once.
    """
    acting: list[int] = []
    deciding: list[int] = []
    before = -1
    for number, latency_us in enumerate(latencies_us):
        n = max(0, latency_us // dt_us - 1)
        deciding.append(len(acting))
        acting += [number if n == 0 else before] * (n + 1)
        before = number
    return acting, deciding


@given(latencies, steps)
def test_the_clock_follows_the_rule(latencies_us: list[int], dt_us: int) -> None:
    held = HeldControl(-1, dt_us)
    expected, expected_decisions = by_the_text(latencies_us, dt_us)

    acting, decided_at = list[int](), list[int]()
    for frame in range(len(expected)):
        if held.decision_is_due:
            held.decide(len(decided_at), latencies_us[len(decided_at)])
            decided_at.append(frame)
        acting.append(held.advance())

    assert acting == expected
    assert decided_at == expected_decisions
    assert held.decision_is_due


@pytest.mark.parametrize(
    ("latency_us", "frames"),
    [(0, 0), (1, 1), (50_000, 1), (50_001, 2), (150_000, 3), (430_000, 9)],
)
def test_a_pipeline_delays_by_the_frames_begun(latency_us: int, frames: int) -> None:
    assert delayed_frames(latency_us) == frames


def acting(clock: PipelinedControl[int], latencies_us: list[int]) -> list[int]:
    found = list[int]()
    for frame, latency_us in enumerate(latencies_us):
        assert clock.decision_is_due
        clock.decide(frame, latency_us)
        found.append(clock.advance())
    return found


@given(latencies, steps)
def test_a_pipeline_is_a_queue(latencies_us: list[int], dt_us: int) -> None:
    """Decision k is out when it and all before it are ready; the newest out acts."""
    found = acting(PipelinedControl(-1, dt_us), latencies_us)

    for frame, acts in enumerate(found):
        out = [
            k
            for k in range(frame + 1)
            if all(j + -(-latencies_us[j] // dt_us) <= frame for j in range(k + 1))
        ]
        assert acts == max(out, default=-1)


def test_without_latency_both_models_act_at_once() -> None:
    for model in LatencyModel:
        clock = control_clock(model, -1, 50_000)
        clock.decide(0, 0)
        assert clock.advance() == 0


@pytest.mark.parametrize("charged", [50.5, -3, float("nan")])
@pytest.mark.parametrize("count", [skipped_decisions, delayed_frames])
def test_what_is_no_whole_microseconds_is_refused(
    count: Callable[[Any], int], charged: object
) -> None:
    with pytest.raises(EvaluationError, match="must be whole microseconds, 0 or more"):
        count(charged)
