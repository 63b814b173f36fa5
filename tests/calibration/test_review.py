"""What of ranges deserves a look, and files that contradict themselves."""

import dataclasses
import json
import re
from collections.abc import Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.base.errors import FramesError, RecipeError
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.observers import (
    OBSERVERS,
    MeanSquaredError,
    Percentile,
    scale_of,
    within,
)
from me2e_compress.calibration.ranges import Activity, Ranges, review
from me2e_compress.calibration.statistics import Statistics
from me2e_compress.graph import infer_shapes
from me2e_compress.operators.kernels.kernel import BINS
from tests.support.frames import record
from tests.support.nets import conv_attention, image, parsed
from tests.support.profiles import scaled

GOOD = Ranges(
    {"a": (-1.0, 4.0), "b": (0.0, 2.0)},
    "max-min",
    16,
    "graph",
    "frames",
    rms={"a": 1.0, "b": 0.5},
    scenes=8,
    inputs={"img": "varies"},
    outputs={"plan": "varies"},
)


def lines(ranges: Ranges) -> list[tuple[str, str]]:
    return [(each.severity, str(each)) for each in review(ranges)]


def test_nothing_is_said_of_good_ranges() -> None:
    assert lines(GOOD) == []


@pytest.mark.parametrize(
    ("rms", "severity", "said"),
    [
        (4 / 254, "warning", r"1 range of 254 or more .*: a \(254\)\. Look for"),
        (4 / 253, "note", r"1 range of over 64 times .*: a \(253\)"),
        (4 / 64, None, ""),
        (4.001, "warning", r"1 range below the root mean square.*: a \(1\)\."),
        (4, None, ""),
    ],
)
def test_a_range_is_held_against_the_tensor_itself(
    rms: float, severity: str | None, said: str
) -> None:
    found = lines(dataclasses.replace(GOOD, method="mse", rms={"a": rms}))

    assert [each for each, _ in found] == ([severity] if severity else [])
    assert re.search(said, "".join(line for _, line in found))


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"tensors": {"a": (0.0, 0.0)}, "rms": {}}, "1 tensor always zero: a. Nothing"),
        ({"inputs": {"prev_bev": "zero"}}, "1 input zero in every frame: prev_bev. A"),
        ({"inputs": {"command": "constant"}}, "1 input the same in every frame: comm"),
        ({"outputs": {"plan": "zero"}}, "1 output the same in every frame: plan. What"),
        ({"outputs": {"plan": "constant"}}, "1 output the same in every frame: plan"),
        ({"outputs": {"plan": "not finite"}}, "1 output with NaN or infinity: plan"),
        ({"scenes": 7}, "16 frames in 7 scenes. Frames of one scene look alike: rec"),
    ],
)
def test_what_was_not_seen_is_told(change: Mapping[str, object], said: str) -> None:
    (found,) = review(dataclasses.replace(GOOD, **change))  # type: ignore[arg-type]

    assert str(found).startswith(said)
    assert found.advice or found.kind == "few elements"


def test_one_frame_does_not_say_what_changes() -> None:
    one = dataclasses.replace(
        GOOD, frames=1, scenes=8, inputs={"img": "constant"}, outputs={"p": "constant"}
    )
    assert lines(one) == []


def recorded(folder: Path, images: list[int], scenes: tuple[int, ...]) -> Ranges:
    frames = [image(seed) for seed in images]
    recording = CalibrationSet(record(folder, frames, scenes))
    return Calibrator(threads=1).run(conv_attention(), ["a", "seen"], recording)


@pytest.mark.parametrize(
    ("images", "scenes", "inputs", "outputs"),
    [
        ([1, 2, 3], (0,), {"image": "varies", "memory": "varies"}, "varies"),
        ([1, 2, 3], (0, 1, 2), {"image": "varies", "memory": "zero"}, "varies"),
        ([1, 1, 1], (0, 1, 2), {"image": "constant", "memory": "zero"}, "constant"),
        ([1, 1, 1], (0, 2), {"image": "constant", "memory": "varies"}, "varies"),
    ],
)
def test_calibration_tells_what_inputs_and_outputs_did(
    tmp_path: Path,
    images: list[int],
    scenes: tuple[int, ...],
    inputs: dict[str, Activity],
    outputs: Activity,
) -> None:
    found = recorded(tmp_path, images, scenes)

    assert found.inputs == inputs
    assert found.outputs == {"y": outputs, "memory_out": outputs}
    assert (found.frames, found.scenes) == (3, len(scenes))


def test_an_output_that_no_tensor_shows_to_be_infinite_is_found(tmp_path: Path) -> None:
    model = parsed(
        "m (float[2] x) => (float[2] y, float[2] z) { y = Log(x)\n z = Abs(x) }"
    )
    frames = [{"x": np.array(each, np.float32)} for each in ([1, 2], [0, 3])]

    found = Calibrator(threads=1).run(
        model, ["x"], CalibrationSet(record(tmp_path, frames))
    )

    assert found.outputs == {"y": "not finite", "z": "varies"}
    assert found.not_finite.startswith("y (Log) is first to make NaN or infinity, in y")


SAMPLED = """
m (float[1,1,4,4] x, float[1,2,2,2] xy, float[1,2,2,1] depth, bool[1] hidden)
    => (float[1,1,2,2] y) <float never = {-inf}, float one = {1}, float two = {2}>
{
    zero = Cast <to = 1> (hidden)
    off = Where(hidden, never, zero)
    weight = Softplus(off)
    [project] uv = Div(xy, depth)
    turned = Mul(uv, two)
    grid = Add(turned, weight)
    sampled = GridSample(x, grid)
    y = Relu(sampled)
}
"""


def test_who_made_the_grid_not_a_number_is_named(tmp_path: Path) -> None:
    flat = np.zeros((1, 2, 2, 2), np.float32)
    frames = [
        {
            "x": np.ones((1, 1, 4, 4), np.float32),
            "xy": flat,
            "depth": flat[..., :1] + depth,
            "hidden": np.array([True]),
        }
        for depth in (1, 0, 1)
    ]
    recording, model = (
        CalibrationSet(record(tmp_path / "frames", frames)),
        parsed(SAMPLED),
    )
    infer_shapes(model)

    found = Calibrator(threads=1).run(model, ["x", "y"], recording)

    assert found.not_finite == (
        "project (Div) is first to make NaN or infinity, in uv; 2 tensors behind it"
    )
    (line,) = (each for each in review(found) if each.kind == "not finite")
    assert str(line).startswith(found.not_finite)
    found.save(tmp_path / "r.json")
    assert Ranges.load(tmp_path / "r.json") == found
    with pytest.raises(FramesError, match=r"read from it; project \(Div\) is first"):
        Calibrator(threads=1).run(model, ["turned"], recording)


def test_the_root_mean_square_is_over_all_frames(tmp_path: Path) -> None:
    found = recorded(tmp_path, [1, 2], (0,))

    seen = [image(seed)["image"] for seed in (1, 2)]
    whole = Calibrator(threads=1).run(
        conv_attention(), ["image"], CalibrationSet(tmp_path)
    )
    assert whole.rms["image"] == pytest.approx(np.sqrt(np.mean(np.square(seen))), 1e-3)
    assert found.crests["a"] == max(map(abs, found.tensors["a"])) / found.rms["a"]


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"frames": 0}, "max-min of 0 frames; give a recording"),
        ({"frames": -3, "scenes": None}, "max-min of -3 frames"),
        ({"scenes": 17}, "17 scenes in 16 frames"),
        ({"scenes": 0}, "0 scenes in 16 frames"),
        ({"rms": {"x": 1.0}}, "the root mean square of x, which has no range"),
        ({"rms": {"a": -1.0}}, "a has a root mean square of -1"),
        ({"inputs": {"img": "moves"}}, "inputs.img"),
    ],
)
def test_a_file_that_contradicts_itself_is_refused(
    tmp_path: Path, change: Mapping[str, object], said: str
) -> None:
    path = tmp_path / "r.json"
    dataclasses.replace(GOOD, **change).save(path)  # type: ignore[arg-type]

    with pytest.raises(FramesError, match=rf"r\.json: not ranges: {said}"):
        Ranges.load(path)


def test_a_file_of_an_earlier_version_is_read(tmp_path: Path) -> None:
    path = tmp_path / "r.json"
    GOOD.save(path)
    held = json.loads(path.read_text())
    for key in ("rms", "scenes", "inputs", "outputs"):
        del held[key]
    path.write_text(json.dumps({**held, "outliers": {"a": 110.0}}))

    found = Ranges.load(path)

    assert (found.tensors, found.rms, found.scenes) == (GOOD.tensors, {}, None)
    assert review(found) == ()


Values = npt.NDArray[np.float64]


def seen(*tensors: Values) -> Statistics:
    """Statistics of one frame, computed the plain way."""
    measured = np.array(
        [[(x.min(), x.max(), np.mean(x * x)) for x in tensors]], np.float32
    )
    names = tuple(f"t{at}" for at in range(len(tensors)))
    bare = Statistics("m", "s", names, (0,), measured)
    counts = [
        np.histogram(np.abs(x), BINS, (0, 2.0**e))[0]
        for x, e in zip(tensors, bare.exponents, strict=True)
    ]
    return Statistics("m", "s", names, (0,), measured, np.array(counts))


def extremes(*frames: tuple[float, float]) -> Statistics:
    measured = np.array([[(low, high, 1)] for low, high in frames], np.float32)
    return Statistics("m", "s", ("t",), tuple(range(len(frames))), measured)


def reach(method: object, x: Values) -> float:
    lows, highs = method.ranges(seen(x))  # type: ignore[attr-defined]
    return float(max(-lows[0], highs[0]))


@pytest.mark.parametrize(
    ("low", "high", "scale"),
    [(-1.27, 0.5, 0.01), (0.0, 12.7, 0.1), (-254.0, 254.0, 2.0), (0.0, 0.0, 1.0)],
)
def test_a_scale_covers_the_larger_side(low: float, high: float, scale: float) -> None:
    assert scale_of(low, high) == np.float32(scale)


@pytest.mark.parametrize("end", [np.nan, np.inf])
def test_what_is_no_number_has_no_step(end: float) -> None:
    with pytest.raises(FramesError, match="has no int8 step"):
        scale_of(-end, 1.0)
    with pytest.raises(FramesError, match="has no int8 step"):
        scale_of(-1.0, end)


@settings(max_examples=scaled(25))
@given(st.floats(0.5, 100), st.integers(0, 9))
def test_a_percentile_leaves_out_no_more_than_it_may(percent: float, seed: int) -> None:
    drawn = np.random.default_rng(seed).standard_cauchy(5000)
    x = drawn.astype(np.float32).astype(np.float64)  # as elements are
    found = reach(Percentile(percent), x)
    magnitudes = np.abs(x)
    bin_width = 2.0 ** np.frexp(magnitudes.max())[1] / BINS

    assert np.mean(magnitudes <= found) >= percent / 100
    assert np.mean(magnitudes <= found - bin_width) < percent / 100


def test_the_mse_threshold_is_the_best_of_a_search_over_the_elements() -> None:
    x = np.random.default_rng(3).standard_t(4, size=20_000)

    def noise(threshold: float) -> float:
        step = threshold / 127
        rounded = np.clip(np.rint(x / step), -127, 127) * step
        return float(np.mean((x - rounded) ** 2))

    best = min(noise(t) for t in np.linspace(0.2, 1, 400) * np.abs(x).max())
    found = noise(reach(MeanSquaredError(), x))

    assert found < noise(np.abs(x).max().item()) * 0.95
    assert found == pytest.approx(best, rel=0.03)


@pytest.mark.parametrize("method", [Percentile(), MeanSquaredError()])
def test_no_method_reaches_beyond_what_was_seen(method: object) -> None:
    x = np.random.default_rng(1).uniform(0, 3, 500)
    lows, highs = method.ranges(seen(x, np.zeros(4)))  # type: ignore[attr-defined]

    assert lows[0] == np.float32(x.min())
    assert 0 < highs[0] <= np.float32(x.max())
    assert (lows[1], highs[1]) == (0, 0)


def test_histogram_methods_say_that_they_lack_histograms() -> None:
    with pytest.raises(FramesError, match="no histograms"):
        Percentile().ranges(extremes((0, 1)))


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("fp8", "no calibration method 'fp8'; there are max-min, percentile, mse"),
        ("mse:3", "mse takes no value, found '3'"),
        ("percentile:x", "percentile: percent: Input should be a valid number"),
        ("percentile:nan", "percentile: percent must be above 0"),
        ("percentile:0", "must be above 0 and at most 100, found 0"),
        ("entropy", "^no calibration method 'entropy'; there are"),
    ],
)
def test_what_is_no_method_is_refused(text: str, message: str) -> None:
    with pytest.raises(RecipeError, match=message):
        OBSERVERS.parse(text)


def test_a_range_shrinks_to_what_was_seen_where_the_reach_lies_inside() -> None:
    """A tensor that never comes near zero: half of its largest is below its least."""
    measured = np.array([[[3.0, 4.0, 12.0], [-4.0, -3.0, 12.0]]], np.float32)
    seen = Statistics("", "", ("above", "below"), (0,), measured)

    low, high = within(seen, np.array([2.0, 2.0], np.float32))

    assert (low <= high).all()
    assert low.tolist() == [3.0, -3.0]
    assert high.tolist() == [3.0, -3.0]
