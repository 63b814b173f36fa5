import pytest

from benchmarks.bench_intervals import KeptDrive, coverage, intra_type_correlation, told


def test_the_correlation_by_hand() -> None:
    # two of each: between types 2 * var(2, 6) = 16, within 2, (16 - 2) / (16 + 2)
    rows = [("a", 1.0), ("a", 3.0), ("b", 5.0), ("b", 7.0)]

    assert intra_type_correlation(rows) == pytest.approx(7 / 9)


@pytest.mark.parametrize(
    ("routes", "measured"),
    [
        (("Merge_0", "Merge_1", "Exit_0", "Exit_1"), True),
        (("Merge_R2_0", "Exit_R2_0"), False),
        (("Merge_0", "Merge_1", "Exit_0"), False),
    ],
    ids=["two of each", "one of each", "one of a type"],
)
def test_a_correlation_that_is_not_measured_is_left_out(
    routes: tuple[str, ...], measured: bool
) -> None:
    drive = KeptDrive({route: (10.0 * at, 0.0) for at, route in enumerate(routes)})

    assert (drive.correlation is not None) is measured
    assert ("correlation" in told(drive)) is measured
    assert "nan" not in told(drive)


def test_one_type_alone_has_no_correlation_and_no_types_anew() -> None:
    drive = KeptDrive({"Merge_0": (10.0, 0.0), "Merge_1": (20.0, 0.0)})

    assert drive.correlation is None
    assert told(drive).startswith("DS 15.0 (10.0 to 20.0), SR 0.0 (")


def test_a_few_sets_are_counted() -> None:
    found = coverage(0.3, 3, seed=1)

    assert all(0.0 <= share <= 1.0 for share in found.values())
