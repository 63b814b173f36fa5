from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.sample import draw, hold_out
from me2e_compress.errors import FramesError
from tests.frames import record


def recording(folder: Path, count: int, scenes: tuple[int, ...]) -> CalibrationSet:
    frames = [{"x": np.full(1, at, np.float32)} for at in range(count)]
    return CalibrationSet(record(folder / "frames", frames, scenes))


@pytest.mark.parametrize(
    ("count", "scenes", "calibrated", "measured"),
    [
        (2, (0,), [0], [1]),
        (6, (0,), [0, 1, 2, 3, 4], [5]),
        (32, (0,), list(range(28)), [28, 29, 30, 31]),
        # Whole scenes, where that leaves half of the frames.
        (12, (0, 4, 8), list(range(8)), [8, 9, 10]),
        (8, (0, 2, 4, 6), [0, 1, 2, 3, 4, 5], [6, 7]),
        # The scene is longer than half of the recording.
        (8, (0, 2), [0, 1, 2, 3, 4, 5], [6, 7]),
        # One frame is all there is.
        (1, (0,), [0], [0]),
    ],
)
def test_the_last_frames_are_held_out(
    tmp_path: Path,
    count: int,
    scenes: tuple[int, ...],
    calibrated: list[int],
    measured: list[int],
) -> None:
    seen, kept = hold_out(recording(tmp_path, count, scenes), 4)

    assert [frame.index for frame in seen] == calibrated
    assert [frame.index for frame in kept] == measured


def test_state_begins_anew_where_a_scene_is_cut(tmp_path: Path) -> None:
    _, kept = hold_out(recording(tmp_path, 8, (0,)), 4)

    assert [frame.starts_scene for frame in kept] == [True, False]


def test_frames_are_drawn_by_seed_in_whole_scenes(tmp_path: Path) -> None:
    scenes = (0, 2, 3, 5)
    frames = recording(tmp_path, 7, scenes)

    drawn = [draw(frames, 4, seed).places for seed in range(20)]

    assert draw(frames, 4, 7).places == drawn[7]
    assert len(set(drawn)) > 5
    for places in drawn:
        assert list(places) == sorted(set(places))
        assert len(places) == 4
        for place in places:
            assert place in scenes or place - 1 in places
    assert draw(frames, 99, 3).places == tuple(range(7))
    with pytest.raises(FramesError, match="0 frames were asked for"):
        draw(frames, 0, 0)
