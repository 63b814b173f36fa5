"""CRITIC against a hand-worked example, and what must not change its weights."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays

from me2e_compress.errors import EvaluationError
from me2e_compress.metrics.eer import critic_weights

BY_HAND = np.array([[0, 0, 0], [0, 1, 1], [1, 1, 0], [1, 1, 1]], np.float64)

tables = arrays(np.float64, (6, 4), elements=st.floats(0, 1, width=16))


def weights_of(rows: np.ndarray) -> np.ndarray | None:
    try:
        return critic_weights(rows)
    except EvaluationError:
        return None


def test_the_example_by_hand() -> None:
    outer, middle = (2 - 1 / math.sqrt(3)) / 2, (math.sqrt(3) - 1) / 2
    contents = np.array([outer, middle, outer])

    assert critic_weights(BY_HAND) == pytest.approx(contents / contents.sum())


@pytest.mark.parametrize("unit", [1e-15, 1e15])
def test_the_unit_of_all_measures_does_not_matter(unit: float) -> None:
    assert critic_weights(unit * BY_HAND) == pytest.approx(critic_weights(BY_HAND))


def test_a_constant_measure_weighs_nothing_and_changes_nothing() -> None:
    constant = np.full((4, 1), 0.7)

    found = critic_weights(np.hstack([constant, BY_HAND]))

    assert found[0] == 0.0
    assert found[1:] == pytest.approx(critic_weights(BY_HAND))


@pytest.mark.parametrize(
    ("rows", "vary"),
    [
        (np.ones((4, 3)), 0),
        (np.array([[0.0, 1.0], [1.0, 1.0]]), 1),
        (np.array([[0.0, 3.0], [1.0, 1.0], [0.5, 2.0]]), 2),
        (np.ones((1, 4)), 0),
    ],
)
def test_measures_that_say_the_same_have_no_weights(
    rows: np.ndarray, vary: int
) -> None:
    with pytest.raises(EvaluationError, match=f"rows {vary} vary"):
        critic_weights(rows)


@given(tables, st.permutations(range(6)))
def test_neither_the_order_of_rows_nor_a_sign_nor_an_offset_matters(
    rows: np.ndarray, order: list[int]
) -> None:
    found, other = weights_of(rows), weights_of(1.0 - rows[order])

    assert (found is None) == (other is None)
    if found is not None and other is not None:
        assert found == pytest.approx(other, abs=1e-6)
        assert found.sum() == pytest.approx(1.0)
        assert (found >= 0.0).all()


@given(tables, st.floats(0.1, 100.0))
def test_one_scale_for_all_measures_does_not_matter(
    rows: np.ndarray, factor: float
) -> None:
    found, other = weights_of(rows), weights_of(factor * rows)

    assert (found is None) == (other is None)
    if found is not None:
        assert found == pytest.approx(other, abs=1e-6)
