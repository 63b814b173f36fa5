import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.differences import difference
from me2e_compress.metrics.infraction import InfractionKind
from me2e_compress.metrics.intervals import bootstrap_interval, paired_interval
from tests.metrics.drives import drive, infraction

CRASH = infraction(InfractionKind.COLLISION_VEHICLE)
GOOD = [drive(route=name) for name in "abcd"]
BAD = [drive(CRASH, route="a", completion=50.0), *GOOD[1:]]


def test_the_mean_of_differences_route_by_route() -> None:
    found = difference(BAD, GOOD)

    assert found.driving_score.value == pytest.approx((30.0 - 100.0) / 4)
    assert found.success_rate.value == pytest.approx(-25.0)
    assert found.driving_score.measure.unit == "points"
    assert (found.better, found.worse) == (0, 1)


def test_the_order_of_the_reference_does_not_matter() -> None:
    assert difference(BAD, GOOD[::-1]) == difference(BAD, GOOD)


def test_the_other_way_round_has_the_other_sign() -> None:
    one, other = (difference(*pair) for pair in ((BAD, GOOD), (GOOD, BAD)))

    assert one.driving_score.value == pytest.approx(-(other.driving_score.value or 0.0))
    assert (one.better, one.worse) == (other.worse, other.better)


def test_a_drive_does_not_differ_from_itself() -> None:
    found = difference(BAD, BAD).driving_score

    assert (found.value, found.low, found.high) == (0.0, 0.0, 0.0)


def test_one_route_has_no_interval() -> None:
    found = difference(BAD[:1], GOOD[:1]).driving_score

    assert (found.value, found.low, found.high, found.n) == (-70.0, None, None, 1)


def test_other_routes_are_named() -> None:
    with pytest.raises(EvaluationError, match="route d was driven by one"):
        difference(BAD[:3], GOOD)


def test_what_is_hard_for_both_cancels_out() -> None:
    random = np.random.default_rng(5)
    hard = random.normal(50.0, 20.0, 60)
    one, other = hard + random.normal(0.0, 1.0, 60) + 2.0, hard

    low, high = paired_interval(one.tolist(), other.tolist())
    assert low is not None
    assert high is not None
    wide_low, wide_high = bootstrap_interval(one.tolist())
    assert wide_low is not None
    assert wide_high is not None
    assert 0.0 < low < 2.0 < high
    assert high - low < (wide_high - wide_low) / 5


def test_unequal_lengths_are_no_pairs() -> None:
    with pytest.raises(ValueError, match="zip"):
        paired_interval([1.0, 2.0], [1.0])


@given(
    st.lists(st.tuples(st.floats(0, 100), st.floats(0, 100)), min_size=2, max_size=12),
    st.integers(0, 2**32 - 1),
)
def test_the_interval_turns_with_the_sign(
    pairs: list[tuple[float, float]], seed: int
) -> None:
    one, other = (list(column) for column in zip(*pairs, strict=True))

    low, high = paired_interval(one, other, seed)
    back_low, back_high = paired_interval(other, one, seed)

    assert (low, high) == pytest.approx((-(back_high or 0.0), -(back_low or 0.0)))
