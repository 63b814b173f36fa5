import dataclasses
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from onnxruntime.quantization import calibrate as peer

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.sample import FrameSubset
from me2e_compress.errors import FramesError, GraphError, RecipeError
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import Session, replay
from tests.frames import record
from tests.nets import conv_attention, image, parsed

TENSORS = ("image", "a", "r", "seen", "q", "scores", "p", "mixed")


class Reader(peer.CalibrationDataReader):  # type: ignore[misc]
    """Feeds the other tool what a replay feeds ours."""

    def __init__(self, frames: list[dict[str, np.ndarray]]) -> None:
        self._frames: Iterator[dict[str, np.ndarray]] = iter(frames)

    def get_next(self) -> Any:
        return next(self._frames, None)


@pytest.fixture
def frames(tmp_path: Path) -> CalibrationSet:
    return CalibrationSet(record(tmp_path / "f", [image(i) for i in range(4)], (0, 2)))


def test_ranges_are_those_of_onnxruntime_to_the_bit(
    frames: CalibrationSet, tmp_path: Path
) -> None:
    model = conv_attention()
    path = tmp_path / "net.onnx"
    graph.save(model, path)
    tool = peer.create_calibrator(
        path,
        ["Conv", "Relu", "Add", "MatMul", "Softmax", "Transpose"],
        augmented_model_path=str(tmp_path / "augmented.onnx"),
        calibrate_method=peer.CalibrationMethod.MinMax,
    )
    zeros: dict[str, Array] = {"memory": np.zeros((1, 8, 64), np.float32)}
    memory = zeros
    plain = Session(model, threads=1, optimize=False)
    states = []
    for each, after in zip(frames, replay(plain, frames), strict=True):
        states.append({**(zeros if each.starts_scene else memory), **each.arrays})
        memory = {"memory": after["memory_out"]}
    tool.collect_data(Reader(states))
    theirs = tool.compute_data().data

    ours = Calibrator("max-min", threads=1, optimize=False).run(model, TENSORS, frames)

    for name in TENSORS:
        low, high = (end.item() for end in theirs[name].range_value)
        assert ours.tensors[name] == (low, high), name


def test_state_is_fed_forward_and_reset_between_scenes(tmp_path: Path) -> None:
    one = [{"image": image(0)["image"]}] * 4
    together = CalibrationSet(record(tmp_path / "a", one, (0,)))
    apart = CalibrationSet(record(tmp_path / "b", one, (0, 1, 2, 3)))
    model = conv_attention()

    def highest(frames: CalibrationSet) -> float:
        calibrator = Calibrator("max-min", threads=1)
        return calibrator.run(model, ["seen"], frames).tensors["seen"][1]

    # memory after n equal frames adds 1/2 + 1/4 + 1/8 of what one frame shows
    assert highest(together) == pytest.approx(highest(apart) * 1.875, rel=1e-5)


@pytest.mark.parametrize("at", [0, 7, 150])
@pytest.mark.parametrize(("bad", "word"), [(np.nan, "NaN"), (np.inf, "infinite")])
def test_what_is_not_a_number_is_found_wherever_it_hides(
    tmp_path: Path, at: int, bad: float, word: str
) -> None:
    second = image(1)
    second["image"].flat[at] = bad
    frames = CalibrationSet(record(tmp_path, [image(0), second]))

    with pytest.raises(FramesError, match=f"frame 1 makes tensor image {word}"):
        Calibrator(threads=1).run(conv_attention(), ["image"], frames)


def test_dead_tensors_are_named(tmp_path: Path) -> None:
    dark = {"image": np.zeros((1, 3, 8, 8), np.float32)}
    frames = CalibrationSet(record(tmp_path, [dark]))

    found = Calibrator(threads=1).run(conv_attention(), ["image", "a"], frames)

    assert found.dead == ("image",)


def test_a_tensor_whose_range_one_element_makes_is_named(tmp_path: Path) -> None:
    lone = {"image": np.ones((1, 3, 64, 64), np.float32)}
    lone["image"].flat[5] = 1e4
    frames = CalibrationSet(record(tmp_path, [lone]))
    model = parsed(
        "m (float[1,3,64,64] image) => (float[1,3,64,64] y) { y = Relu(image) }"
    )

    found = Calibrator(threads=1).run(model, ["image", "y"], frames)

    # sqrt(12288) = 110.9 is the crest factor of one element among as many zeros
    assert found.outliers == pytest.approx({"image": 110, "y": 110}, rel=0.02)


def test_an_unknown_tensor_or_method_is_an_error(frames: CalibrationSet) -> None:
    with pytest.raises(GraphError, match="no tensor nowhere"):
        Calibrator().run(conv_attention(), ["nowhere"], frames)
    with pytest.raises(RecipeError, match=r"no calibration method 'int4'; .*max-min"):
        Calibrator("int4").run(conv_attention(), ["a"], frames)


@pytest.fixture
def ranges(frames: CalibrationSet) -> Ranges:
    return Calibrator("max-min", threads=1).run(conv_attention(), ["a"], frames)


def test_saved_ranges_come_back(ranges: Ranges, tmp_path: Path) -> None:
    ranges.save(tmp_path / "r.json")

    assert Ranges.load(tmp_path / "r.json") == ranges
    assert [each.name for each in tmp_path.glob("*.json")] == ["r.json"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"model": "other"}, "r.json: stale: of graph other"),
        ({"source": "other"}, "r.json: stale: of frames other"),
        ({"method": "mse"}, "r.json: of method mse, asked for max-min"),
        ({"tensors": {}}, "r.json: lacks a and 0 more of 1"),
    ],
)
def test_stale_ranges_are_refused(
    ranges: Ranges, change: dict[str, object], message: str
) -> None:
    stale = dataclasses.replace(ranges, **change)  # type: ignore[arg-type]

    with pytest.raises(FramesError, match=message):
        stale.check(
            model=ranges.model,
            tensors=("a",),
            method="max-min",
            source=ranges.source,
            named="r.json",
        )


@pytest.mark.parametrize("content", ["[", "{}", '{"tensors": 1}'])
def test_a_file_that_holds_no_ranges_is_refused(tmp_path: Path, content: str) -> None:
    path = tmp_path / "r.json"
    path.write_text(content)

    with pytest.raises(FramesError, match=r"r\.json: not ranges"):
        Ranges.load(path)
    with pytest.raises(FramesError, match="no such ranges"):
        Ranges.load(tmp_path / "none.json")


def test_no_frames_are_an_error(frames: CalibrationSet) -> None:
    with pytest.raises(FramesError, match="no frames to calibrate on"):
        Calibrator(threads=1).run(conv_attention(), ["a"], FrameSubset(frames, ()))
