import dataclasses
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import onnx_ir as ir
import pytest
from onnxruntime.quantization import calibrate as peer

from me2e_compress import graph
from me2e_compress.base.errors import FramesError, GraphError, RecipeError
from me2e_compress.calibration import statistics
from me2e_compress.calibration.calibrator import Calibrator, Extremes
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.statistics import Probe, Statistics, insert_probes
from me2e_compress.runtime.frames import Array, Frame
from me2e_compress.runtime.providers import CPU, CpuProvider, Provider
from me2e_compress.runtime.session import Session, replay
from tests.support.frames import record
from tests.support.nets import conv_attention, image, parsed

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

    whole = f"frame 1 makes tensor image {word}: no range"
    with pytest.raises(FramesError, match=whole):
        Calibrator(threads=1).run(conv_attention(), ["image"], frames)
    with pytest.raises(FramesError, match=f"image {word}, and of 3 a, r: no range"):
        Calibrator(threads=1).run(conv_attention(), ["image", "a", "r"], frames)


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


def test_an_unknown_tensor_or_method_and_no_frames_are_errors(
    frames: CalibrationSet,
) -> None:
    with pytest.raises(FramesError, match="no frames to calibrate on"):
        Calibrator(threads=1).run(conv_attention(), ["a"], frames.part(()))
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
        ({"tensors": {}}, "r.json: of 1 tensors lacks a; "),
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


FOUR = ("image", "a", "seen", "mixed")


class Killed(CalibrationSet):
    """A recording whose reader dies at the n-th frame it reads."""

    def __init__(self, folder: Path, after: int) -> None:
        super().__init__(folder)
        self.left = after

    def __getitem__(self, index: int) -> Frame:
        if not self.left:
            raise KeyboardInterrupt
        self.left -= 1
        return super().__getitem__(index)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    return record(tmp_path / "frames", [image(seed) for seed in range(6)], (0, 4))


@pytest.mark.parametrize("after", [1, 2, 3, 4, 5])
def test_a_killed_calibration_goes_on_where_it_was(
    folder: Path, tmp_path: Path, after: int
) -> None:
    path = tmp_path / "standing.npz"
    calibrator = Calibrator("mse", threads=1, checkpoint=path, every=2)
    model = conv_attention()
    with pytest.raises(KeyboardInterrupt):
        calibrator.collect(model, FOUR, Killed(folder, after))

    rest = Killed(folder, 6 - after + after % 2)
    seen = calibrator.collect(model, FOUR, rest)

    whole = Calibrator("mse", threads=1).collect(model, FOUR, CalibrationSet(folder))
    np.testing.assert_array_equal(seen.measured, whole.measured)
    np.testing.assert_array_equal(seen.checksums, whole.checksums)
    np.testing.assert_array_equal(seen.histograms(), whole.histograms())
    assert rest.left == 0
    assert not path.exists()


@dataclasses.dataclass(frozen=True)
class Elsewhere(CpuProvider):
    """The same kernels under another name."""

    name: ClassVar[str] = "elsewhere"


@dataclasses.dataclass(frozen=True)
class Other:
    """What a later calibration differs in from the one that was killed."""

    tensors: tuple[str, ...] = FOUR
    method: str = "mse"
    optimize: bool = True
    provider: Provider = CPU
    model: int = 0
    first_image: int = 0
    last_frames: int = 6


@pytest.mark.parametrize(
    ("other", "message"),
    [
        (Other(tensors=FOUR[:1]), "another list of tensors"),
        (Other(method="max-min"), "another kind of statistics"),
        (Other(optimize=False), "another optimization level"),
        (Other(provider=Elsewhere()), "another provider"),
        (Other(model=1), "another model"),
        (Other(first_image=1), "another recording"),
        (Other(last_frames=2), "another choice of frames"),
    ],
)
def test_the_checkpoint_of_another_calibration_is_refused(
    folder: Path, tmp_path: Path, other: Other, message: str
) -> None:
    path = tmp_path / "standing.npz"
    with pytest.raises(KeyboardInterrupt):
        Calibrator("mse", threads=1, checkpoint=path, every=1).collect(
            conv_attention(), FOUR, Killed(folder, 2)
        )
    images = [image(seed + other.first_image) for seed in range(6)]
    whole = CalibrationSet(record(tmp_path / "other", images, (0, 4)))
    frames = whole.part(range(6)[-other.last_frames :])

    with pytest.raises(FramesError, match=f"stale: a checkpoint of {message};"):
        Calibrator(
            other.method, threads=1, optimize=other.optimize, checkpoint=path,
            provider=other.provider,
        ).collect(conv_attention(other.model), other.tensors, frames)  # fmt: skip


def test_a_file_that_is_no_checkpoint_is_refused(folder: Path, tmp_path: Path) -> None:
    path = tmp_path / "standing.npz"
    path.write_bytes(b"PK")

    with pytest.raises(FramesError, match="not a checkpoint"):
        Calibrator(threads=1, checkpoint=path).collect(
            conv_attention(), FOUR, CalibrationSet(folder)
        )


def test_where_all_that_is_read_is_finite_no_other_tensor_is_looked_at(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """To look at all of VAD-tiny's took 15 GB."""
    asked, whole = list[int](), insert_probes

    def counted(model: ir.Model, tensors: Sequence[str], probe: Probe) -> ir.Model:
        asked.append(len(tensors))
        return whole(model, tensors, probe)

    monkeypatch.setattr(statistics, "insert_probes", counted)
    model, probe = conv_attention(), Extremes()
    inputs = {**image(0), **Session(model).first_state(image(0))}

    assert not statistics.first_bad_node(model, inputs, {FOUR[1]}, probe, CPU)
    assert asked == [1]


# A tensor that has no element on some frames, as what is detected often has.


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
