import dataclasses
import json
from collections.abc import Iterator
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.atomic import IN_JSON
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import CalibrationSet, PixelInput
from me2e_compress.calibration.recording import Begin, Source, write_recording
from me2e_compress.runtime.frames import Frame
from tests.support.frames import record
from tests.support.nets import parsed


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


def test_what_is_written_is_read_and_says_where_it_is_from(tmp_path: Path) -> None:
    origin: dict[str, str | int] = {"stack": "s", "seed": 4}
    folder = write_recording(tmp_path / "new" / "frames", source(3), origin)

    read = list(CalibrationSet(folder))
    for frame, expected in zip(read, drawn(3), strict=True):
        assert (frame.index, frame.starts_scene) == (
            expected.index,
            expected.starts_scene,
        )
        assert list(frame.arrays) == list(expected.arrays)
        for name, array in expected.arrays.items():
            np.testing.assert_array_equal(frame.arrays[name], array)
    index = json.loads((folder / "scenes.json").read_text())
    assert index == {**IN_JSON, "scenes": [0, 2], **origin, "count": 3}


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


def test_a_file_is_not_a_folder_and_no_frames_write_nothing(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="there are no frames to write"):
        write_recording(tmp_path / "frames", source(0), {})
    assert list(tmp_path.iterdir()) == []
    (tmp_path / "frames").write_text("mine")
    with pytest.raises(FramesError, match="is a file"):
        write_recording(tmp_path / "frames", source(1), {})


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


# Images as bytes on disk: every reader sees the floats that the model takes.


MODEL = """
model (float[1,2,3,4,6] img, float[1] speed) => (float[1,2,3,4,6] y)
<float[1] half = {0.5}> {
    far = Mul(img, half)
    y = Add(far, speed)
}
"""
PIXELS = PixelInput(
    mean=(123.675, 116.28, 103.53),
    std=(58.395, 57.12, 57.375),
    order="rgb",
    rows=4,
    columns=6,
)


def pictures(count: int = 2) -> list[np.ndarray]:
    """Three rows of five columns: one of each is left to pad."""
    random = np.random.default_rng(0)
    return [random.integers(0, 256, (1, 2, 3, 3, 5), np.uint8) for _ in range(count)]


def padded(picture: np.ndarray) -> np.ndarray:
    mean = np.array(PIXELS.mean, np.float32)[:, None, None]
    std = np.array(PIXELS.std, np.float32)[:, None, None]
    ready = np.zeros((1, 2, 3, 4, 6), np.float32)
    ready[..., :3, :5] = (picture.astype(np.float32) - mean) / std
    return ready


def written(folder: Path, *, as_bytes: bool) -> CalibrationSet:
    frames = [
        Frame(
            index,
            index == 0,
            {
                "img": each if as_bytes else padded(each),
                "speed": np.array([index], np.float32),
            },
        )
        for index, each in enumerate(pictures())
    ]
    pixels = {"img": PIXELS} if as_bytes else None
    write_recording(folder, lambda begin: iter(frames), {}, pixels=pixels)
    return CalibrationSet(folder)


@pytest.fixture
def model() -> ir.Model:
    return parsed(MODEL)


def test_bytes_on_disk_are_fed_as_the_floats_they_stand_for(
    tmp_path: Path, model: ir.Model
) -> None:
    recording = written(tmp_path, as_bytes=True)

    recording.check(model)  # it knows the shape that is fed
    with np.load(recording.files[0]) as held:
        assert held["img"].dtype == np.uint8
        np.testing.assert_array_equal(held["img"], pictures()[0])
    for frame, picture in zip(recording, pictures(), strict=True):
        np.testing.assert_array_equal(frame.arrays["img"], padded(picture))


def test_another_normalisation_is_another_fingerprint(tmp_path: Path) -> None:
    before = written(tmp_path, as_bytes=True).fingerprint
    index = tmp_path / "scenes.json"
    index.write_text(index.read_text().replace("123.675", "103.53"))

    assert CalibrationSet(tmp_path).fingerprint != before


def test_a_reader_that_does_not_know_pixels_refuses_them(
    tmp_path: Path, model: ir.Model
) -> None:
    written(tmp_path, as_bytes=True)
    index = json.loads((tmp_path / "scenes.json").read_text())
    del index["pixels"]
    (tmp_path / "scenes.json").write_text(json.dumps(index))

    with pytest.raises(FramesError, match="img is uint8, expected float32"):
        CalibrationSet(tmp_path).check(model)


@pytest.mark.parametrize(
    ("pixels", "message"),
    [
        ({"version": 2}, "pixels: version: Input should be 1"),
        ({"version": 1, "colour": 1}, "scenes.json: pixels: colour"),
        ([], "scenes.json: pixels"),
        ({"inputs": {"img": {"mean": [0, 0, 0]}}}, "pixels: inputs.img.std"),
        (
            {"inputs": {"img": {**PIXELS.model_dump(), "std": [1, 0, 1]}}},
            "pixels: inputs.img.std.1: .*greater than 0",
        ),
    ],
)
def test_malformed_pixels_are_named(tmp_path: Path, pixels: Any, message: str) -> None:
    record(tmp_path, [{"img": pictures()[0]}])
    index = {"scenes": [0], "pixels": pixels}
    (tmp_path / "scenes.json").write_text(json.dumps(index))

    with pytest.raises(FramesError, match=message):
        CalibrationSet(tmp_path)


@pytest.mark.parametrize(
    ("array", "message"),
    [
        (np.zeros((1, 2, 3, 3, 5), np.float32), "img is float32, pixels are uint8"),
        (np.zeros((3, 5), np.uint8), r"img has shape \[3, 5\], pixels are \[..., 3, h"),
        (np.zeros((1, 2, 3, 5, 5), np.uint8), "img .*, more than 4 rows or 6 columns"),
    ],
)
def test_what_is_no_picture_is_named(
    tmp_path: Path, array: np.ndarray, message: str
) -> None:
    record(tmp_path, [{"img": array}])
    index = {"scenes": [0], "pixels": {"inputs": {"img": PIXELS.model_dump()}}}
    (tmp_path / "scenes.json").write_text(json.dumps(index))

    with pytest.raises(FramesError, match=f"000000.npz: {message}"):
        _ = CalibrationSet(tmp_path)[0]
