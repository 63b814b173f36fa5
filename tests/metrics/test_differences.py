from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.episode import Infraction, InfractionKind
from me2e_compress.metrics.measure import Estimate, Measure
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
    found = difference(BAD, GOOD)

    assert found.driving_score.value == pytest.approx((30.0 - 100.0) / 4)
    assert found.success_rate.value == pytest.approx(-25.0)
    assert found.driving_score.measure.unit == "points"
    assert (found.better, found.worse) == (0, 1)


def test_room_is_compared_where_both_drives_recorded_it() -> None:
    near, far = (
        [replace(each, ttc_exposure=percent, at_fault=False) for each in GOOD]
        for percent in (30.0, 10.0)
    )

    assert difference(near, far).room_kept.value == pytest.approx(-20.0)
    assert difference(near, GOOD).room_kept.measure.reason == "no route has a room %"


def test_the_order_of_the_reference_does_not_matter() -> None:
    assert difference(BAD, GOOD[::-1]) == difference(BAD, GOOD)


def test_the_other_way_round_has_the_other_sign() -> None:
    one, other = (difference(*pair) for pair in ((BAD, GOOD), (GOOD, BAD)))

    assert one.driving_score.value == pytest.approx(-(other.driving_score.value or 0.0))
    assert (one.better, one.worse) == (other.worse, other.better)


def test_where_nothing_differs_the_interval_is_what_may_be_unseen() -> None:
    found = difference(BAD, BAD)

    # with 95 % at most 1 - 0.05 ** (1 / 4) of all routes differ, by 100 points each
    share = 100.0 * (1.0 - 0.05**0.25)
    score = found.driving_score
    assert score.value == 0.0
    assert (score.low, score.high) == pytest.approx((-share, share))
    assert found.unseen_percent == pytest.approx(share)
    assert found.differ == 0


def test_four_routes_that_differ_alike_say_little_of_a_fifth() -> None:
    worse = [driven(CRASH, route=name, completion=50.0) for name in "abcd"]

    found = difference(worse, GOOD)

    share = 1.0 - 0.05**0.25
    low, high = -70.0 - share * 30.0, -70.0 + share * 170.0
    score = found.driving_score
    assert (score.low, score.high) == pytest.approx((low, high))
    assert found.verdict == "no difference shown"


def test_success_is_compared_by_mcnemars_exact_test() -> None:
    names = [str(i) for i in range(20)]
    one = [driven(*[CRASH] * (k < 1), route=name) for k, name in enumerate(names)]
    other = [driven(*[CRASH] * (k > 11), route=name) for k, name in enumerate(names)]

    found = difference(one, other)

    # 8 routes gained, 1 lost: 2 * (1 + 9) / 2 ** 9
    assert (found.gained, found.lost) == (8, 1)
    assert found.p_value == pytest.approx(20 / 512)
    assert difference(one, one).p_value == 1.0


def test_holm_by_hand() -> None:
    assert holm([0.01, 0.04, 0.03]) == pytest.approx((0.03, 0.06, 0.06))
    assert holm([0.9, 0.6]) == (1.0, 1.0)
    assert holm([]) == ()


@given(st.lists(st.floats(0, 1), max_size=6))
def test_holm_only_raises_and_keeps_the_order(p_values: list[float]) -> None:
    found = holm(p_values)

    assert all(p <= new <= 1.0 for p, new in zip(p_values, found, strict=True))
    ranked = [new for _, new in sorted(zip(p_values, found, strict=True))]
    assert ranked == sorted(ranked)


def test_one_route_has_no_interval() -> None:
    found = difference(BAD[:1], GOOD[:1]).driving_score

    assert (found.value, found.low, found.high, found.n) == (-70.0, None, None, 1)


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
    assert paired(routes, low, high).smallest_shown == pytest.approx(least, abs=0.05)


@pytest.mark.parametrize(
    ("routes", "low", "high", "value", "said"),
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
    routes: int, low: float | None, high: float | None, value: float, said: str
) -> None:
    assert paired(routes, low, high, value).verdict == said
