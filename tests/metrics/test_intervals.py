"""Intervals over these types, over types drawn anew, and where nothing differed."""

import math
from statistics import fmean, pstdev

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.metrics.measure import (
    Estimate,
    binomial_interval,
    mean_estimate,
    unseen_share,
)

TYPES = [f"type {i // 5}" for i in range(220)]


def alike(correlation: float) -> list[float]:
    """220 routes of 44 types with mean 50 and deviation 10, correlated in a type."""
    random = np.random.default_rng(3)
    shared = np.repeat(random.normal(0, math.sqrt(correlation), 44), 5)
    own = random.normal(0.0, math.sqrt(1.0 - correlation), 220)
    return [50.0 + 10.0 * float(value) for value in shared + own]


def halves(found: Estimate) -> tuple[float, float]:
    """Half the width of both intervals."""
    ends = (found.low, found.high, found.anew_low, found.anew_high)
    assert None not in ends
    low, high, anew_low, anew_high = (end or 0.0 for end in ends)
    return (high - low) / 2, (anew_high - anew_low) / 2


def test_each_interval_is_as_wide_as_its_standard_error_says() -> None:
    values = alike(0.3)
    here, anew = halves(mean_estimate(values, TYPES, "%"))

    table = np.reshape(values, (44, 5))
    within = table.var(axis=1, ddof=1).mean()
    assert here == pytest.approx(1.96 * math.sqrt(within / 220), rel=0.05)
    between = table.mean(axis=1).var(ddof=1)
    assert anew == pytest.approx(1.96 * math.sqrt(between / 44), rel=0.05)
    assert anew > here


def test_where_no_type_has_two_routes_both_are_the_plain_bootstrap() -> None:
    values, n = alike(0.0), 220
    found = mean_estimate(values, [str(i) for i in range(n)], "%")

    error = pstdev(values) / math.sqrt(n - 1)
    assert halves(found) == pytest.approx((1.96 * error,) * 2, rel=0.05)
    assert found.value == pytest.approx(fmean(values))


def test_the_same_seed_gives_the_same_intervals() -> None:
    one, same, other = (
        mean_estimate(alike(0.3), TYPES, "%", seed) for seed in (1, 1, 2)
    )

    assert one == same
    assert one != other


@pytest.mark.parametrize(
    ("bounds", "interval"),
    [
        ((0.0, 100.0), (100 - 100 * (1 - 0.05**0.1), 100.0)),
        ((-100.0, 200.0), (100 - 200 * (1 - 0.05**0.1), 100 + 100 * (1 - 0.05**0.1))),
    ],
)
def test_routes_that_all_are_equal_have_no_interval_of_no_width(
    bounds: tuple[float, float], interval: tuple[float, float]
) -> None:
    found = mean_estimate([100.0] * 10, TYPES[:10], "%", bounds=bounds)

    assert (found.low, found.high) == pytest.approx(interval)
    # two types: 1 - 0.05 ** (1 / 2)
    low = 100 - (100 - bounds[0]) * (1 - 0.05**0.5)
    assert found.anew_low == pytest.approx(low)


def test_types_that_are_all_or_nothing_leave_routes_unseen() -> None:
    found = mean_estimate([0.0] * 5 + [100.0] * 5, TYPES[:10], "%", bounds=(0, 100))

    share = unseen_share(10)
    assert (found.low, found.high) == pytest.approx((50 - 50 * share, 50 + 50 * share))
    assert unseen_share(220) == pytest.approx(3 / 220, rel=0.01)


def test_what_has_no_interval() -> None:
    """Equal values without bounds, one route; of one type none over others."""
    equal, one = mean_estimate([7.0] * 6, TYPES[:6], "s"), mean_estimate([3.0], "a", "")
    alone = mean_estimate([3.0, 4.0, 9.0], ["a"] * 3, "%")

    assert (equal.low, equal.high, equal.anew_low, one.low) == (None,) * 4
    assert alone.low is not None
    assert (alone.anew_low, alone.anew_high) == (None, None)


@given(
    st.lists(
        st.tuples(st.floats(-100, 100), st.sampled_from("abc")), min_size=2, max_size=12
    ),
    st.integers(0, 2**32 - 1),
)
def test_the_intervals_turn_with_the_sign(
    rows: list[tuple[float, str]], seed: int
) -> None:
    values, types = zip(*rows, strict=True)

    found = mean_estimate(values, types, "points", seed, (-100, 100))
    back = mean_estimate([-v for v in values], types, "points", seed, (-100, 100))

    assert found.low == pytest.approx(-(back.high or 0.0), abs=1e-6)
    assert found.high == pytest.approx(-(back.low or 0.0), abs=1e-6)


def test_the_exact_binomial_interval() -> None:
    # Clopper and Pearson: with no failure the lower end is (alpha / 2) ** (1 / n).
    low, high = binomial_interval(10, 10)

    assert low == pytest.approx(100 * 0.025**0.1)
    assert high == 100.0
