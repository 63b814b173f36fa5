"""P-values over scenario types drawn anew."""

import itertools
from statistics import fmean

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.paper.evidence import drawn_anew, p_value
from me2e_compress.metrics import measure

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


def test_types_drawn_anew_are_as_all_draws_by_brute_force(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(measure, "FEWEST_TYPES", len(UNEVEN))  # all draws of 8: 2e6
    types = [name for name, values in UNEVEN.items() for _ in values]
    values = [value for each in UNEVEN.values() for value in each]

    draws, exact = anew_of(values, types), np.array(every_draw())

    found = measure.mean_estimate(values, types, "%")
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
