"""P-values over scenario types drawn anew."""

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from benchmarks.paper.evidence import drawn_anew, p_value


def anew_of(values: list[float], types: list[str]) -> np.ndarray:
    rows = np.stack([values, np.ones(len(values))], axis=1)
    return drawn_anew(rows, types, lambda sums: sums[:, 0] / sums[:, 1], seed=0)


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
