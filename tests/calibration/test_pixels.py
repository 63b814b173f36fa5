"""Images as bytes on disk: every reader sees the floats that the model takes."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.dataset import CalibrationSet, PixelInput
from me2e_compress.calibration.recording import write_recording
from me2e_compress.errors import FramesError
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session, replay
from tests.frames import record
from tests.nets import parsed

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


def test_bytes_are_fed_as_the_floats_they_stand_for(tmp_path: Path) -> None:
    recording = written(tmp_path, as_bytes=True)

    for frame, picture in zip(recording, pictures(), strict=True):
        np.testing.assert_array_equal(frame.arrays["img"], padded(picture))


def test_bytes_stay_bytes_on_disk(tmp_path: Path) -> None:
    recording = written(tmp_path, as_bytes=True)

    with np.load(recording.files[0]) as held:
        assert held["img"].dtype == np.uint8
        np.testing.assert_array_equal(held["img"], pictures()[0])


def test_bytes_and_floats_give_the_same_outputs(
    tmp_path: Path, model: ir.Model
) -> None:
    answers = [
        [
            each["y"]
            for each in replay(Session(model), written(tmp_path / str(k), as_bytes=k))
        ]
        for k in (True, False)
    ]

    np.testing.assert_array_equal(answers[0], answers[1])


def test_the_check_knows_the_shape_that_is_fed(tmp_path: Path, model: ir.Model) -> None:
    written(tmp_path, as_bytes=True).check(model)


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
        ({"version": 2}, "pixels of version 2: a later me2e-compress wrote them"),
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
