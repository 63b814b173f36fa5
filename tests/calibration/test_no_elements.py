"""A tensor that has no element on some frames, as what is detected often has."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.statistics import Statistics
from tests.frames import record
from tests.nets import parsed

FOUND = """
found (float[8] scores) => (float[N] kept)
<float none = {0.0}> {
    sure = Greater(scores, none)
    kept = Compress(scores, sure)
}
"""
NOTHING = -np.ones(8, np.float32)


def frames_of(folder: Path, *scores: np.ndarray) -> CalibrationSet:
    frames = [{"scores": each} for each in scores]
    return CalibrationSet(record(folder, frames, (0,)))


@pytest.mark.parametrize("method", OBSERVERS.names())
def test_frames_without_elements_change_no_range(method: str, tmp_path: Path) -> None:
    random = np.random.default_rng(11)
    some = [random.uniform(-1, 1, 8).astype(np.float32) for _ in range(3)]
    model = parsed(FOUND)
    calibrator = Calibrator(method, threads=1)
    whole = calibrator.run(model, ["kept"], frames_of(tmp_path / "a", *some))

    apart = frames_of(tmp_path / "b", NOTHING, some[0], NOTHING, *some[1:])
    found = calibrator.run(model, ["kept"], apart)

    assert found.tensors["kept"] == whole.tensors["kept"]


def test_what_never_has_an_element_is_dead(tmp_path: Path) -> None:
    model = parsed(FOUND)
    frames = frames_of(tmp_path / "f", NOTHING, NOTHING)

    found = Calibrator(threads=1).run(model, ["scores", "kept"], frames)

    assert found.tensors["kept"] == (0.0, 0.0)
    assert found.dead == ("kept",)


def test_gaps_are_filled_from_before_or_else_from_behind() -> None:
    gap = (np.inf, -np.inf, 0.0)
    measured = np.array([[gap], [(1, 2, 3)], [gap], [gap], [(4, 5, 6)]], np.float32)

    seen = Statistics("", "", ("t",), (0, 1, 2, 3, 4), measured)

    assert seen.lows[:, 0].tolist() == [1, 1, 1, 1, 4]
    assert seen.highs[:, 0].tolist() == [2, 2, 2, 2, 5]
    assert seen.mean_squares[:, 0].tolist() == [3, 3, 3, 3, 6]
    assert seen.reach.tolist() == [5]
