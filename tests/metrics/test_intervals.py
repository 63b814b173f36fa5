"""Intervals over these types, over types drawn anew, and where nothing differed."""

import itertools
import math
from statistics import fmean, pstdev

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.metrics.intervals import (
    binomial_interval,
    drawn_anew,
    mean_estimate,
    p_value,
    unseen_share,
)
from me2e_compress.metrics.measure import Estimate

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


def test_equal_values_without_bounds_have_no_interval() -> None:
    found = mean_estimate([7.0] * 6, TYPES[:6], "s")

    assert (found.low, found.high, found.anew_low) == (None, None, None)


def test_one_route_has_no_interval_and_one_type_none_over_others() -> None:
    assert mean_estimate([3.0], ["a"], "%").low is None

    found = mean_estimate([3.0, 4.0, 9.0], ["a"] * 3, "%")
    assert found.low is not None
    assert (found.anew_low, found.anew_high) == (None, None)


def test_the_rule_of_three() -> None:
    assert unseen_share(220) == pytest.approx(3 / 220, rel=0.01)


@given(
    st.lists(
        st.tuples(st.floats(-100, 100), st.sampled_from("abc")),
        min_size=2,
        max_size=12,
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


UNEVEN = {"a": [1.0, 5.0], "b": [-3.0], "c": [2.0, 2.0, 9.0], "d": [0.5]}


def every_draw() -> list[float]:
    """The mean of every ordered draw of three of four types, by hand."""
    return [
        fmean(value for name in drawn for value in UNEVEN[name])
        for drawn in itertools.product(UNEVEN, repeat=3)
    ]


def anew_of(values: list[float], types: list[str]) -> np.ndarray:
    rows = np.stack([values, np.ones(len(values))], axis=1)
    return drawn_anew(rows, types, lambda sums: sums[:, 0] / sums[:, 1], seed=0)


def test_types_drawn_anew_are_as_all_draws_by_brute_force() -> None:
    types = [name for name, values in UNEVEN.items() for _ in values]
    values = [value for each in UNEVEN.values() for value in each]

    draws, exact = anew_of(values, types), np.array(every_draw())

    found = mean_estimate(values, types, "%")
    for end, percent in ((found.anew_low, 2.5), (found.anew_high, 97.5)):
        assert end == pytest.approx(float(np.percentile(exact, percent)), abs=0.35)
    for edge in (-1.5, 0.2, 2.0, 4.1):
        assert float((draws <= edge).mean()) == pytest.approx(
            float((exact <= edge).mean()), abs=0.015
        )
        least = min((exact <= edge).mean(), (exact >= edge).mean())
        assert p_value(draws, edge) == pytest.approx(min(1.0, 2 * least), abs=0.03)


@given(st.lists(st.floats(-50, 50), min_size=20, max_size=60), st.floats(-60, 60))
def test_a_p_value_is_below_a_twentieth_where_the_interval_excludes_the_edge(
    values: list[float], edge: float
) -> None:
    draws = anew_of(values, [str(at // 4) for at in range(len(values))])
    low, high = np.percentile(draws, (2.4, 97.6))
    inner_low, inner_high = np.percentile(draws, (2.6, 97.4))

    p = p_value(draws, edge)

    assert p == p_value(-draws, -edge)
    if np.ptp(draws) > 1e-6 and (edge < low or edge > high):
        assert p < 0.05
    if inner_low < edge < inner_high:
        assert p >= 0.05


def test_draws_that_all_are_equal_say_nothing_of_what_was_not_seen() -> None:
    assert p_value(np.full(99, 3.0), 0.0) == 1.0
    assert p_value(np.zeros(0), 0.0) == 1.0
    assert len(anew_of([1.0, 2.0], ["a", "a"])) == 0


def test_a_p_value_is_never_zero() -> None:
    assert p_value(np.arange(1.0, 1000.0), 0.0) == pytest.approx(2 / 1000)
