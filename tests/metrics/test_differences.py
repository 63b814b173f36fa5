import math
from dataclasses import replace
from statistics import fmean, pstdev

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.episode import Infraction, InfractionKind
from me2e_compress.metrics.measure import (
    Estimate,
    Measure,
    binomial_interval,
    mean_estimate,
    unseen_share,
)
from me2e_compress.metrics.route_summary import (
    PairedDifference,
    RouteSummary,
    difference,
    holm,
)
from tests.metrics.drives import drive, infraction

CRASH = infraction(InfractionKind.COLLISION_VEHICLE)


def driven(*hits: Infraction, route: str, completion: float = 100.0) -> RouteSummary:
    return RouteSummary.of(drive(*hits, route=route, completion=completion))


GOOD = [driven(route=name) for name in "abcd"]
BAD = [driven(CRASH, route="a", completion=50.0), *GOOD[1:]]


def test_the_mean_of_differences_route_by_route() -> None:
    result = difference(BAD, GOOD)

    assert result.driving_score.value == pytest.approx((30.0 - 100.0) / 4)
    assert result.success_rate.value == pytest.approx(-25.0)
    assert result.driving_score.measure.unit == "points"
    assert (result.routes_better, result.routes_worse) == (0, 1)
    assert difference(BAD, GOOD[::-1]) == result


def test_room_is_compared_where_both_drives_recorded_it() -> None:
    near, far = (
        [replace(route, ttc_exposure=percent, at_fault=False) for route in GOOD]
        for percent in (30.0, 10.0)
    )

    assert difference(near, far).room_kept.value == pytest.approx(-20.0)
    assert difference(near, GOOD).room_kept.measure.reason == "no route has a room %"


def test_where_nothing_differs_the_interval_is_what_may_be_unseen() -> None:
    result = difference(BAD, BAD)

    # with 95 % at most 1 - 0.05 ** (1 / 4) of all routes differ, by 100 points each
    share = 100.0 * (1.0 - 0.05**0.25)
    score = result.driving_score
    assert score.value == 0.0
    assert (score.low, score.high) == pytest.approx((-share, share))
    assert (result.routes_better, result.routes_worse) == (0, 0)


def test_four_routes_that_differ_alike_say_little_of_a_fifth() -> None:
    worse = [driven(CRASH, route=name, completion=50.0) for name in "abcd"]

    result = difference(worse, GOOD)

    share = 1.0 - 0.05**0.25
    low, high = -70.0 - share * 30.0, -70.0 + share * 170.0
    score = result.driving_score
    assert (score.low, score.high) == pytest.approx((low, high))
    assert result.verdict == "no difference shown"


def test_success_is_compared_by_mcnemars_exact_test() -> None:
    names = [str(i) for i in range(20)]
    one = [driven(*[CRASH] * (k < 1), route=name) for k, name in enumerate(names)]
    other = [driven(*[CRASH] * (k > 11), route=name) for k, name in enumerate(names)]

    result = difference(one, other)

    # 8 routes gained, 1 lost: 2 * (1 + 9) / 2 ** 9
    assert (result.success_gained, result.success_lost) == (8, 1)
    assert result.mcnemar_p == pytest.approx(20 / 512)
    assert difference(one, one).mcnemar_p == 1.0


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx((0.03, 0.06, 0.06))
    assert holm([0.9, 0.6]) == (1.0, 1.0)
    assert holm([]) == ()


@given(st.lists(st.floats(0, 1), max_size=6))
def test_holm_only_raises_and_keeps_the_order(p_values: list[float]) -> None:
    result = holm(p_values)

    assert all(p <= new <= 1.0 for p, new in zip(p_values, result, strict=True))
    ranked = [new for _, new in sorted(zip(p_values, result, strict=True))]
    assert ranked == sorted(ranked)


def test_one_route_has_no_interval() -> None:
    result = difference(BAD[:1], GOOD[:1]).driving_score

    assert (result.value, result.low, result.high, result.n) == (-70.0, None, None, 1)


def test_other_routes_are_named() -> None:
    with pytest.raises(EvaluationError, match="route d was driven by one"):
        difference(BAD[:3], GOOD)


def paired(
    routes: int, low: float | None, high: float | None, value: float = 0.0
) -> PairedDifference:
    score = Estimate(Measure(value, "points"), low, high, routes)
    return PairedDifference(score, score, score, 0, 0)


@pytest.mark.parametrize(
    ("routes", "low", "high", "least"),
    [
        (220, -1.0, 1.0, 3.4),
        (5, 0.0, 0.0, 22.8),  # all alike: five routes show little nevertheless
        (5, -0.3, 60.6, 30.45),
        (1, None, None, 51.0),
    ],
)
def test_few_routes_show_only_large_differences(
    routes: int, low: float | None, high: float | None, least: float
) -> None:
    assert paired(routes, low, high).least_detectable == pytest.approx(least, abs=0.05)


@pytest.mark.parametrize(
    ("routes", "low", "high", "value", "verdict"),
    [
        (220, 0.7, 6.7, 3.7, "better"),
        (220, -6.7, -0.7, -3.7, "worse"),
        (220, -0.9, 9.6, 4.3, "no difference shown"),
        (220, 0.2, 1.8, 1.0, "too few routes"),  # below the 3.4 that 220 show
        (4, 1.0, 20.0, 11.0, "too few routes"),
        (1, None, None, 60.0, "too few routes"),
        (220, 0.04, 8.0, 4.0, "no difference shown"),  # shown as 0.0
    ],
)
def test_a_verdict_asks_for_the_interval_and_for_enough_routes(
    routes: int, low: float | None, high: float | None, value: float, verdict: str
) -> None:
    assert paired(routes, low, high, value).verdict == verdict


# Intervals over these types, over types drawn anew, and where nothing differed.


TYPES = [f"type {i // 5}" for i in range(220)]
SHARE = 1 - 0.05**0.025


def alike(correlation: float) -> list[float]:
    """220 routes of 44 types with mean 50 and deviation 10, correlated in a type."""
    random = np.random.default_rng(3)
    shared = np.repeat(random.normal(0, math.sqrt(correlation), 44), 5)
    own = random.normal(0.0, math.sqrt(1.0 - correlation), 220)
    return [50.0 + 10.0 * float(value) for value in shared + own]


def halves(result: Estimate) -> tuple[float, float]:
    """Half the width of both intervals."""
    ends = (result.low, result.high, result.anew_low, result.anew_high)
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
    result = mean_estimate(values, [str(i) for i in range(n)], "%")

    error = pstdev(values) / math.sqrt(n - 1)
    assert halves(result) == pytest.approx((1.96 * error,) * 2, rel=0.05)
    assert result.value == pytest.approx(fmean(values))


def test_the_same_seed_gives_the_same_intervals() -> None:
    one, same, other = (
        mean_estimate(alike(0.3), TYPES, "%", seed) for seed in (1, 1, 2)
    )

    assert one == same
    assert one != other


@pytest.mark.parametrize(
    ("bounds", "interval"),
    [
        ((0.0, 100.0), (100 - 100 * SHARE, 100.0)),
        ((-100.0, 200.0), (100 - 200 * SHARE, 100 + 100 * SHARE)),
    ],
)
def test_routes_that_all_are_equal_have_no_interval_of_no_width(
    bounds: tuple[float, float], interval: tuple[float, float]
) -> None:
    result = mean_estimate([100.0] * 40, TYPES[:40], "%", bounds=bounds)

    assert (result.low, result.high) == pytest.approx(interval)
    # eight types: 1 - 0.05 ** (1 / 8)
    low = 100 - (100 - bounds[0]) * (1 - 0.05**0.125)
    assert result.anew_low == pytest.approx(low)


def test_types_that_are_all_or_nothing_leave_routes_unseen() -> None:
    result = mean_estimate([0.0] * 5 + [100.0] * 5, TYPES[:10], "%", bounds=(0, 100))

    share = unseen_share(10)
    assert (result.low, result.high) == pytest.approx(
        (50 - 50 * share, 50 + 50 * share)
    )
    assert unseen_share(220) == pytest.approx(3 / 220, rel=0.01)


def test_what_has_no_interval() -> None:
    """Equal values without bounds, one route; of seven types none over others."""
    equal, one = mean_estimate([7.0] * 6, TYPES[:6], "s"), mean_estimate([3.0], "a", "")
    alone = mean_estimate(alike(0.3)[:35], TYPES[:35], "%")

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

    result = mean_estimate(values, types, "points", seed, (-100, 100))
    back = mean_estimate([-v for v in values], types, "points", seed, (-100, 100))

    assert result.low == pytest.approx(-(back.high or 0.0), abs=1e-6)
    assert result.high == pytest.approx(-(back.low or 0.0), abs=1e-6)


def test_the_exact_binomial_interval() -> None:
    # Clopper and Pearson: with no failure the lower end is (alpha / 2) ** (1 / n).
    low, high = binomial_interval(10, 10)

    assert low == pytest.approx(100 * 0.025**0.1)
    assert high == 100.0
