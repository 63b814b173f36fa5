from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.dataset import CalibrationSet, synthetic
from me2e_compress.errors import FramesError, PreconditionError
from tests.frames import record
from tests.nets import parsed

MODEL = """
model (float[1,2] x, int64[1] command, float[1,2] memory)
    => (float[1,2] memory_out) {
    memory_out = Add(x, memory)
}
"""


def frame(value: float = 0.0) -> dict[str, np.ndarray]:
    return {"x": np.full((1, 2), value, np.float32), "command": np.array([2])}


@pytest.fixture
def model() -> ir.Model:
    return parsed(MODEL)


def test_frames_come_in_order_and_know_their_scene(tmp_path: Path) -> None:
    frames = CalibrationSet(record(tmp_path, [frame(i) for i in range(4)], (0, 2)))

    read = [(each.index, each.starts_scene, each.arrays["x"][0, 0]) for each in frames]

    assert len(frames) == 4
    assert read == [(0, True, 0), (1, False, 1), (2, True, 2), (3, False, 3)]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (
            {"y": np.zeros(1, np.float32)},
            "000001.npz: y is not an input of the model; .*x, command",
        ),
        (
            {"x": np.zeros((1, 3), np.float32)},
            r"x has shape \[1, 3\], expected \[1,2\]",
        ),
        ({"x": np.zeros((1, 2))}, "000001.npz: x is float64, expected float32"),
        (
            {"x": np.array([[0, np.nan]], np.float32)},
            r"000001.npz: x is NaN at \[0, 1\], expected finite",
        ),
        ({"x": np.array([[np.inf, 0]], np.float32)}, r"x is infinite at \[0, 0\]"),
    ],
)
def test_a_frame_that_does_not_fit_is_named(
    tmp_path: Path, model: ir.Model, change: dict[str, np.ndarray], message: str
) -> None:
    frames = CalibrationSet(record(tmp_path, [frame(), {**frame(), **change}]))

    with pytest.raises(FramesError, match=message):
        frames.check(model)


def test_a_missing_input_is_named(tmp_path: Path, model: ir.Model) -> None:
    only_x = {"x": frame()["x"]}

    with pytest.raises(FramesError, match=r"000000.npz: command is missing.*x"):
        CalibrationSet(record(tmp_path, [only_x])).check(model)


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "scenes.json: missing"),
        ("[", "not JSON"),
        ("[0]", "must hold"),
        ('{"scenes": ["0"]}', "must hold"),
        ('{"scenes": []}', "rise from 0"),
        ('{"scenes": [1]}', "rise from 0"),
        ('{"scenes": [0, 0]}', "rise from 0"),
        ('{"scenes": [0, 9]}', "below the 2 frames"),
    ],
)
def test_scenes_that_say_nothing_are_refused(
    tmp_path: Path, content: str | None, message: str
) -> None:
    scenes = record(tmp_path, [frame(), frame()]) / "scenes.json"
    if content is None:
        scenes.unlink()
    else:
        scenes.write_text(content)

    with pytest.raises(FramesError, match=message):
        CalibrationSet(tmp_path)


def test_no_folder_no_frames_and_no_archive_are_errors(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="no such folder"):
        CalibrationSet(tmp_path / "nowhere")
    with pytest.raises(FramesError, match=r"holds no \.npz"):
        CalibrationSet(tmp_path)
    frames = CalibrationSet(record(tmp_path, [frame()]))
    frames.files[0].write_bytes(b"PK not an archive")
    with pytest.raises(FramesError, match=r"000000\.npz: not a readable"):
        frames[0]


def test_the_fingerprint_follows_content_and_scenes_not_the_place(
    tmp_path: Path,
) -> None:
    def seal(name: str, values: list[float], scenes: tuple[int, ...] = (0,)) -> str:
        folder = record(tmp_path / name, [frame(value) for value in values], scenes)
        return CalibrationSet(folder).fingerprint

    same = seal("a", [1, 2])
    assert seal("b", [1, 2]) == same
    assert (
        len({same, seal("c", [2, 1]), seal("d", [1, 3]), seal("e", [1, 2], (0, 1))})
        == 4
    )


def test_synthetic_frames_fit_and_follow_the_seed(model: ir.Model) -> None:
    first, again, other = (
        list(synthetic(model, seed=seed, count=2)) for seed in (1, 1, 2)
    )

    assert [each.starts_scene for each in first] == [True, False]
    assert first[0].arrays.keys() == {"x", "command"}
    assert first[0].arrays["command"].dtype == np.int64
    np.testing.assert_array_equal(first[1].arrays["x"], again[1].arrays["x"])
    assert not np.array_equal(first[0].arrays["x"], other[0].arrays["x"])


def test_open_shapes_have_no_synthetic_frames() -> None:
    model = parsed(MODEL.replace("float[1,2] x", "float[n,2] x"))

    with pytest.raises(PreconditionError, match=r"input x is .*\[n,2\].*give frames"):
        synthetic(model, seed=0, count=1)
