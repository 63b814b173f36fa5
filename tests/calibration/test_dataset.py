from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import FramesError, PreconditionError
from me2e_compress.calibration import dataset
from me2e_compress.calibration.dataset import (
    CalibrationSet,
    draw,
    draw_frames,
    hold_out,
    load_arrays,
)
from tests.fuzz.frames import archive, broken_frames, member
from tests.support.frames import record
from tests.support.nets import parsed

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


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"y": np.zeros(1, np.float32)}, "000001.npz: y is not an input of the model"),
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
        list(draw_frames(model, seed=seed, count=2)) for seed in (1, 1, 2)
    )

    assert [each.starts_scene for each in first] == [True, False]
    assert first[0].arrays.keys() == {"x", "command"}
    assert first[0].arrays["command"].dtype == np.int64
    np.testing.assert_array_equal(first[1].arrays["x"], again[1].arrays["x"])
    assert not np.array_equal(first[0].arrays["x"], other[0].arrays["x"])


def test_open_shapes_have_no_synthetic_frames() -> None:
    model = parsed(MODEL.replace("float[1,2] x", "float[n,2] x"))

    with pytest.raises(PreconditionError, match=r"input x is .*\[n,2\].*give frames"):
        draw_frames(model, seed=0, count=1)


# Sizes are looked at before anything is read.


@pytest.fixture
def unread(monkeypatch: pytest.MonkeyPatch) -> None:
    def read(*_: object, **__: object) -> None:
        raise AssertionError("an array was read")

    monkeypatch.setattr(np, "load", read)


@pytest.mark.usefixtures("unread")
def test_a_zip_bomb_is_not_unpacked(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(dataset, "LARGEST_BYTES", 1_000_000)
    bomb = archive({"x.npy": member("(1000000,)", more=4_000_000)})
    assert len(bomb) < 5_000
    (tmp_path / "bomb.npz").write_bytes(bomb)
    with pytest.raises(FramesError, match="arrays have 4,000,128 bytes, more than"):
        load_arrays(tmp_path / "bomb.npz")


FRAMES = dict(broken_frames())
READABLE = ("extra", "extra-markup", "missing", "double", "half-float", "complex",
            "words", "dates", "fields", "void", "bytes", "flat", "scalar",
            "no-elements", "other-shape", "nan", "infinite", "largest",
            "path", "no-member", "twice", "zeros-behind")  # fmt: skip
"""Archives that are whole, whatever a model says of them."""


@pytest.mark.parametrize("name", FRAMES)
def test_an_archive_that_lies_is_refused(tmp_path: Path, name: str) -> None:
    (tmp_path / "x.npz").write_bytes(FRAMES[name])
    if name in READABLE:
        load_arrays(tmp_path / "x.npz")
        return
    with pytest.raises(FramesError, match=r"x\.npz: not a readable \.npz") as caught:
        load_arrays(tmp_path / "x.npz")
    assert "\n" not in str(caught.value)


def recording(folder: Path, count: int, scenes: tuple[int, ...]) -> CalibrationSet:
    frames = [{"x": np.full(1, at, np.float32)} for at in range(count)]
    return CalibrationSet(record(folder / "frames", frames, scenes))


@pytest.mark.parametrize(
    ("count", "run", "measured", "begin"),
    [
        (2, 1, [1], [1]),
        (16, 1, [1, 4, 6, 9, 12, 14], [1, 4, 6, 9, 12, 14]),
        (96, 1, [*range(3, 96, 6)], [*range(3, 96, 6)]),
        (16, 3, [1, 2, 3, 9, 10, 11], [1, 9]),
        (1, 1, [0], [0]),
    ],
)
def test_held_out_frames_are_spread(
    tmp_path: Path, count: int, run: int, measured: list[int], begin: list[int]
) -> None:
    seen, kept = hold_out(recording(tmp_path, count, (*range(0, count, 4),)), 16, run)

    assert [frame.index for frame in kept] == measured
    assert [frame.index for frame in kept if frame.starts_scene] == begin
    others = [place for place in range(count) if place not in measured] or [0]
    assert [frame.index for frame in seen] == others


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
