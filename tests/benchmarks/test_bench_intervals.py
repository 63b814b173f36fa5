import pytest

from benchmarks.bench_intervals import coverage, intra_type_correlation


def test_the_correlation_by_hand() -> None:
    # two of each: between types 2 * var(2, 6) = 16, within 2, (16 - 2) / (16 + 2)
    rows = [("a", 1.0), ("a", 3.0), ("b", 5.0), ("b", 7.0)]

    assert intra_type_correlation(rows) == pytest.approx(7 / 9)


def test_a_few_sets_are_counted() -> None:
    found = coverage(0.3, 3, seed=1)

    assert all(0.0 <= share <= 1.0 for share in found.values())
