import dataclasses
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.recording import Begin, Source, write_recording
from me2e_compress.errors import FramesError
from me2e_compress.registry.drafts import IN_JSON
from me2e_compress.runtime.frames import Frame


def drawn(count: int, seed: int = 0) -> Iterator[Frame]:
    """Scenes of two frames."""
    random = np.random.default_rng(seed)
    for index in range(count):
        camera = random.normal(size=(1, 4)).astype(np.float32)
        yield Frame(index, index % 2 == 0, {"camera": camera, "turn": np.array([3])})


def source(count: int, seed: int = 0) -> Source:
    """Those frames, from any scene on."""
    return lambda begin: islice(drawn(count, seed), begin.frame, None)


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


def test_what_is_written_is_read(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "new" / "frames", source(3), {"seed": 0})

    read = list(CalibrationSet(folder))
    for frame, expected in zip(read, drawn(3), strict=True):
        assert (frame.index, frame.starts_scene) == (
            expected.index,
            expected.starts_scene,
        )
        assert list(frame.arrays) == list(expected.arrays)
        for name, array in expected.arrays.items():
            np.testing.assert_array_equal(frame.arrays[name], array)


def test_the_index_says_where_the_frames_are_from(tmp_path: Path) -> None:
    folder = write_recording(tmp_path / "frames", source(3), {"stack": "s", "seed": 4})

    assert json.loads((folder / "scenes.json").read_text()) == {
        **IN_JSON,
        "scenes": [0, 2],
        "stack": "s",
        "seed": 4,
        "count": 3,
    }


def test_same_frames_same_bytes(tmp_path: Path) -> None:
    one = write_recording(tmp_path / "one", source(3), {})
    two = write_recording(tmp_path / "two", source(3), {})

    assert files(one) == files(two)


def test_an_earlier_recording_is_replaced(tmp_path: Path) -> None:
    target = write_recording(tmp_path / "frames", source(2), {})
    write_recording(target, source(1, seed=1), {})

    assert list(files(target)) == ["000000.npz", "scenes.json"]
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize("also", [(), ("scenes.json",)])
def test_a_foreign_folder_is_refused(tmp_path: Path, also: tuple[str, ...]) -> None:
    for name in ("thesis.tex", *also):
        (tmp_path / name).write_text("mine")

    with pytest.raises(FramesError, match=r"thesis\.tex"):
        write_recording(tmp_path, source(1), {})
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    path.write_text("mine")

    with pytest.raises(FramesError, match="is a file"):
        write_recording(path, source(1), {})


def test_a_failure_leaves_what_was_there(tmp_path: Path) -> None:
    target = write_recording(tmp_path / "frames", source(2), {})
    before = files(target)

    def broken() -> Iterator[Frame]:
        yield from drawn(1)
        raise FramesError("the camera broke")

    with pytest.raises(FramesError, match="the camera broke"):
        write_recording(target, lambda _: broken(), {})
    assert files(target) == before
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


def test_no_frames(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="there are no frames to write"):
        write_recording(tmp_path / "frames", source(0), {})
    assert list(tmp_path.iterdir()) == []


def killed_after(count: int, begun: list[Begin]) -> Source:
    """Six frames in three scenes, ended by a kill."""

    def make(begin: Begin) -> Iterator[Frame]:
        begun.append(begin)
        for frame in islice(drawn(6), begin.frame, None):
            if frame.index == count:
                raise KeyboardInterrupt
            yield dataclasses.replace(frame, place=10 + frame.index // 2)

    return make


def test_a_recording_goes_on_from_its_last_whole_scene(tmp_path: Path) -> None:
    begun = list[Begin]()
    for count in (3, 5):
        with pytest.raises(KeyboardInterrupt):
            write_recording(tmp_path / "frames", killed_after(count, begun), {}, "k")
        assert not (tmp_path / "frames").exists()
    write_recording(tmp_path / "frames", killed_after(7, begun), {}, "k")

    assert begun == [Begin(), Begin(2, 11), Begin(4, 12)]
    whole = write_recording(tmp_path / "whole", source(6), {}, "k")
    assert files(tmp_path / "frames") == files(whole)
    assert sorted(each.name for each in tmp_path.iterdir()) == ["frames", "whole"]


def test_other_frames_begin_anew(tmp_path: Path) -> None:
    begun = list[Begin]()
    for key in ("one", "other"):
        with pytest.raises(KeyboardInterrupt):
            write_recording(tmp_path / "frames", killed_after(3, begun), {}, key)
    assert begun == [Begin(), Begin()]
