"""Dumps of engines are read, and refused in one line."""

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.engine_dump import EngineDump
from me2e_compress.runtime.frames import Array
from tests.support.frames import record

ANSWERS: list[dict[str, Any]] = [
    {
        "plan": np.full((1, 6, 2), at, np.float32),
        "score": np.array([at, 0.5], np.float32),
    }
    for at in range(3)
]


def as_npz(folder: Path, answers: Sequence[Mapping[str, Array]] = ANSWERS) -> Path:
    return record(folder, answers)


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    return CalibrationSet(record(tmp_path / "frames", [{"x": np.ones(1)}] * 3))


def _read(path: Path, frames: CalibrationSet | None) -> None:
    found = EngineDump(path)
    if frames is not None:
        found.check(frames)


def refused(path: Path, frames: CalibrationSet | None = None) -> str:
    with pytest.raises(FramesError) as caught:
        _read(path, frames)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def test_answers_are_read_by_frame(tmp_path: Path, frames: CalibrationSet) -> None:
    dump = EngineDump(as_npz(tmp_path / "dump"))
    dump.check(frames)

    assert dump.names == ("plan", "score")
    assert len(dump) == 3
    for found, wanted in zip(dump, ANSWERS, strict=True):
        for name, array in wanted.items():
            assert found[name].dtype == array.dtype
            np.testing.assert_array_equal(found[name], array)


def test_a_file_that_is_cut(tmp_path: Path, frames: CalibrationSet) -> None:
    file = as_npz(tmp_path / "dump") / "000001.npz"
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    assert str(file) in refused(tmp_path / "dump", frames)


@pytest.mark.parametrize("place", ["dump", "dump/000000.json"])
def test_json_of_other_tools_is_refused(place: str, tmp_path: Path) -> None:
    (tmp_path / "dump").mkdir()
    (tmp_path / "dump" / "000000.json").write_text("[]")

    assert "JSON of other tools: docs/engine-dumps.md" in refused(tmp_path / place)


@pytest.mark.parametrize("kind", ["complex64", "U4", "V4"])
def test_arrays_of_no_numbers(
    kind: str, tmp_path: Path, frames: CalibrationSet
) -> None:
    changed = [dict(each) for each in ANSWERS]
    changed[2]["plan"] = np.zeros((1, 6, 2), kind)
    as_npz(tmp_path / "dump", changed)
    assert refused(tmp_path / "dump", frames).startswith(
        f"{tmp_path}/dump/000002: plan is {np.dtype(kind)}, which is no number"
    )


@pytest.mark.parametrize(
    ("spoil", "said"),
    [
        (lambda dump: None, "DUMP: no such folder"),
        (
            lambda dump: as_npz(dump, ANSWERS[:2]),
            "answers to 2 frames, FRAMES has 3: the dump is of other frames",
        ),
        (
            lambda dump: (as_npz(dump) / "000001.npz").unlink(),
            "DUMP: 000001 is not answered: answers to 2",
        ),
        (
            lambda dump: (as_npz(dump) / "000002.npz").rename(dump / "000009.npz"),
            "000009 is answered and is no frame of",
        ),
    ],
)
def test_what_is_no_whole_dump_of_the_frames(
    spoil: Callable[[Path], object], said: str, tmp_path: Path, frames: CalibrationSet
) -> None:
    dump = tmp_path / "dump"
    spoil(dump)
    said = said.replace("DUMP", str(dump)).replace("FRAMES", str(frames.folder))
    assert said in refused(dump, frames)


@pytest.mark.parametrize("lacks", [0, 2])
def test_a_frame_without_an_output(
    lacks: int, tmp_path: Path, frames: CalibrationSet
) -> None:
    cut = [dict(each) for each in ANSWERS]
    del cut[lacks]["score"]
    as_npz(tmp_path / "dump", cut)
    assert refused(tmp_path / "dump", frames) == (
        f"{tmp_path}/dump/{lacks:06d}: score is missing; other frames have it"
    )
