import pytest

from benchmarks.bench_intervals import KeptDrive
from benchmarks.observers.drives import METHODS, differences, sign_flip

TYPES = "abcdefgh"


def drive(*scores: float) -> KeptDrive:
    return KeptDrive(
        {f"{kind}_0": (s, 0.0) for kind, s in zip(TYPES, scores, strict=False)}
    )


def test_types_that_all_gain_are_chance_twice_in_256() -> None:
    assert sign_flip(drive(*[1.0] * 8)) == pytest.approx(2 / 256, rel=0.25)
    assert sign_flip(drive(1.0, -1.0)) == 1.0


def test_each_method_is_held_against_max_min_over_all_recordings() -> None:
    drives = {f"{method}-{k}.four": drive(50.0) for method in METHODS for k in (10, 11)}
    drives["mse-10.four"] = drive(56.0)
    drives["float.four"] = drive(0.0)

    found = {name: gap.mean().value for name, gap in differences(drives).items()}

    assert found == {"moving-average": 0, "percentile": 0, "mse": 3, "entropy": 0}
