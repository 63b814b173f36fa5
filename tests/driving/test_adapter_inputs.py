"""An adapter's inputs compared with a graph's."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.frames import record_frames
from me2e_compress.commands.options import FramesOptions
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.adapter.adapter import ModelInputs
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.runtime.session import Session
from tests.driving.observed import RIG, motion, observation
from tests.evaluators.highway.drivers import straight_on

STATE = """
axes = "forward-right"
[feeds.state]
parts = [
    { source = "speed", std = 12.0 },
    { source = "target-point" },
    { source = "command", one_hot = 6 },
]
"""
NOW = motion(0.0, 0.0, 0.0, 6.0)


def inputs_of(folder: Path, ports: str, text: str) -> ModelInputs:
    """Open a model of these inputs, which no node reads, with an adapter."""
    session = Session(straight_on(folder / "m.onnx", inputs=ports), threads=1)
    toml = folder / "a.toml"
    toml.write_text(text)
    return ModelInputs.of(session, Adapter.load(toml), session.recurrent)


def test_parts_stand_one_after_the_other(tmp_path: Path) -> None:
    """TCP's state: speed over 12 m/s, target point, one-hot command."""
    inputs = inputs_of(tmp_path, "float[1, 9] state", STATE)

    result = inputs.feeds(observation(NOW))

    state = [[0.5, 20.0, -5.0, 0, 0, 0, 1, 0, 0]]
    assert result["state"].dtype == np.float32
    np.testing.assert_allclose(result["state"].astype(float), np.array(state))


def test_one_source_keeps_its_shape_and_a_list_of_one_is_flat(tmp_path: Path) -> None:
    text = """
    [feeds.way]
    source = "past"
    steps = 3
    [feeds.flat]
    parts = [{ source = "past", steps = 3, mean = [1.0, 0.0], std = [2.0, 1.0] }]
    """
    inputs = inputs_of(tmp_path, "double[1, 3, 2] way, float16[6] flat", text)

    result = inputs.feeds(observation(NOW))

    assert result["way"].shape == (1, 3, 2)
    np.testing.assert_allclose(result["flat"].astype(float), np.tile([-0.5, 0], 3))


def test_cameras_come_one_by_one_and_are_rendered_in_the_largest_size(
    tmp_path: Path,
) -> None:
    text = """
    [image]
    mean = [0, 0, 0]
    std = [1, 1, 1]
    order = "rgb"
    [images.wide]
    cameras = ["FRONT"]
    [images.behind]
    cameras = ["BACK"]
    layout = "bhwc"
    [feeds.k]
    source = "intrinsics"
    images = "behind"
    """
    ports = "float[1, 3, 90, 160] wide, uint8[1, 45, 80, 3] behind"
    inputs = inputs_of(tmp_path, f"{ports}, float[1, 3, 3] k", text)
    pictures = np.full((6, 90, 160, 3), 7, np.uint8)

    result = inputs.feeds(observation(NOW, images=pictures))

    assert inputs.image_size == (90, 160)
    assert result["behind"].dtype == np.uint8
    assert (result["behind"] == 7).all()
    expected = RIG.intrinsics[3] * [[0.5], [0.5], [1.0]]
    np.testing.assert_allclose(result["k"][0], expected, rtol=1e-4)


UNIAD = """
axes = "right-forward"
[feeds.timestamp]
source = "timestamp"
[feeds.l2g_r_mat]
source = "l2g-rotation"
[feeds.l2g_t]
source = "l2g-translation"
[feeds.img_metas_can_bus]
source = "can-bus"
[feeds.use_prev_bev]
source = "use-previous"
"""


def test_uniads_own_inputs(tmp_path: Path) -> None:
    ports = """double[1] timestamp, float[1, 3, 3] l2g_r_mat, float[1, 3] l2g_t,
        float[18] img_metas_can_bus, int32[1] use_prev_bev"""
    inputs = inputs_of(tmp_path, ports, UNIAD)

    first, second = (inputs.feeds(observation(NOW, at)) for at in (0, 50_000))
    inputs.reset()

    assert second["timestamp"] == pytest.approx([0.05])
    assert first["l2g_r_mat"].shape == (1, 3, 3)
    assert [int(feeds["use_prev_bev"][0]) for feeds in (first, second)] == [0, 1]
    assert inputs.feeds(observation(NOW))["use_prev_bev"] == [0]


SPEED, COMMAND = "[feeds.v]\nsource = 'speed'", "[feeds.v]\nsource = 'command'"
PICTURE = "float[1, 3, 8, 8] v"


@pytest.mark.parametrize(
    ("ports", "text", "words"),
    [
        ("float[1] v", "", "input v is none of img, lidar2img, can_bus, command, time"),
        ("float[1] v", "", r"\[feeds.v\] \(sources: speed, velocity, acceleration"),
        ("float[1] v", "[feeds.w]\nsource = 'speed'", "names input w; there are v"),
        ("float[1] v", "[images.w]", "the adapter names input w; there are v"),
        ("float[1, 2] v", "[feeds.v]\nsource = 'speed'", r"input v has shape \[1, 2\]"),
        ("float[1, 8] state", STATE, r"state has shape \[1, 8\], it must be \[1, 9\]"),
        ("float[1, 4] v", f"{COMMAND}\none_hot = 6", r"\[1, 4\], it must be \[1, 6\]"),
        ("int64[1] v", SPEED, r"input v is tensor\(int64\), a"),
        ("float[1] v", f"{SPEED}\nmean = [1, 2]", "input v: speed: mean and std make"),
        (
            "float[1, 6, 4, 4] v",
            "[feeds.v]\nsource = 'lidar2img'\nimages = 'wide'",
            "input v: images = 'wide' names no image input",
        ),
        (PICTURE, f"[images.v]\n{SPEED}", "feeds input v in two ways"),
        (PICTURE, "[images.v]\ncameras = ['FRONT']", "image normalisation unknown"),
    ],
)
def test_what_does_not_fit_the_graph_is_one_line(
    tmp_path: Path, ports: str, text: str, words: str
) -> None:
    with pytest.raises(EvaluationError, match=words) as caught:
        inputs_of(tmp_path, ports, text)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[feeds.v]\nsource = 'speeds'", "parts.0: no input source 'speeds'"),
        ("[feeds.v]\nspeed = 1", "feeds.v.parts.0: no source is named; there are s"),
        ("[feeds.v]\nsource = 'speed'\nunit = 'm'", "speed has no option 'unit'"),
        ("[feeds.v]\nsource = 'speed'\nstd = 0", "speed: std is zero"),
        ("[feeds.v]\nsource = 'speed'\nmean = 'x'", "feeds.v.parts.0.mean"),
        ("[feeds.v]\nsource = 'speed'\nstd = nan", "feeds.v.parts.0.std"),
        ("[image]\nmean = [nan, 0, 0]\nstd = [1, 1, 1]\norder = 'rgb'", "image.mean.0"),
        ("[image]\nmean = [0, 0, 0]\nstd = [1, 0, 1]\norder = 'rgb'", "std is zero"),
        ("[feeds.v]\nparts = []", "feeds.v.parts: Tuple should have at least 1 item"),
        ("[feeds.v]\nparts = ['speed']", "feeds.v.parts.0: no source is named"),
        ("[feeds]\nv = 'speed'", "feeds.v.parts.0: no source is named"),
        ("[images.v]\ncameras = ['TOP']", "images.v.cameras.0: Input should be 'F"),
    ],
)
def test_a_file_that_makes_no_sense_is_one_line(
    tmp_path: Path, text: str, words: str
) -> None:
    toml = tmp_path / "a.toml"
    toml.write_text(text)

    with pytest.raises(EvaluationError) as caught:
        Adapter.load(toml)
    message: Any = str(caught.value)
    assert message.startswith(f"{toml}: adapter ")
    assert words in message
    assert "\n" not in message


# What recurrent inputs hold where a route begins.


STILL = motion(0.0, 0.0, 0.0)


def counter(folder: Path, *, tracks: str = "1, 6, 2") -> Path:
    """Its plan is what it remembers, which grows by 1, and the time since before."""
    return straight_on(
        folder / "m.onnx",
        inputs=f"float[{tracks}] prev_tracks, float[1] prev_time, float[1] timestamp",
        body="""
            since = Sub (timestamp, prev_time)
            plan = Add (prev_tracks, since)
            next_tracks = Add (prev_tracks, one)
            next_time = Identity (timestamp)""",
        outputs="float[1, 6, 2] plan, float[1, 6, 2] next_tracks, float[1] next_time",
        initializers=", float one = {1.0}",
    )


def policy_of(folder: Path, model: Path, text: str) -> OnnxPolicy:
    toml = folder / "a.toml"
    toml.write_text(text)
    return OnnxPolicy.open(model, Adapter.load(toml))


OF_INPUT = """
[recurrent]
prev_time = { from = "next_time", first = "timestamp" }
"""


def answers(policy: OnnxPolicy, times_us: tuple[int, ...]) -> list[float]:
    plans = [policy.plan(observation(STILL, time_us)) for time_us in times_us]
    return [float(np.asarray(plan.points)[3, 1]) for plan in plans]


def test_a_route_begins_with_the_value_of_another_input(tmp_path: Path) -> None:
    policy = policy_of(tmp_path, counter(tmp_path), OF_INPUT)
    policy.reset(None)

    assert answers(policy, (2_000_000, 2_500_000)) == [0.0, 1.5]
    policy.reset(None)
    assert answers(policy, (7_000_000,)) == [0.0]


@pytest.mark.usefixtures("weights")
def test_recorded_scenes_begin_so_too(tmp_path: Path) -> None:
    model, toml = counter(tmp_path), tmp_path / "a.toml"
    toml.write_text(OF_INPUT)
    options = FramesOptions(count=4, adapter=toml, scene_length=2)

    folder = record_frames(model, tmp_path / "frames", options)

    result = [frame.arrays for frame in CalibrationSet(folder)]
    names = [sorted(arrays) for arrays in result]
    assert names == [["prev_time", "timestamp"], ["timestamp"]] * 2
    assert result[2]["prev_time"] == result[2]["timestamp"]


@pytest.mark.parametrize(
    ("text", "more"),
    [
        ("[recurrent]\nprev_time = 'next_time'", {"prev_time": "next_time"}),
        ("[feeds.prev_time]\nsource = 'speed'", {}),
    ],
)
def test_the_models_other_pairs_stay_but_for_what_the_adapter_feeds(
    tmp_path: Path, text: str, more: dict[str, str]
) -> None:
    policy = policy_of(tmp_path, counter(tmp_path), text)

    assert policy.recurrent == {"prev_tracks": "next_tracks"} | more


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[recurrent]\ntimestamp.first = 'zeros'", "timestamp: no output answers it"),
        ("[recurrent]\nprev_time = { first = 'speed' }", "first value of prev_time: s"),
        (
            "[recurrent]\nprev_tracks = { first = 'timestamp' }",
            r"is tensor\(float\) \[1\], the input takes tensor\(float\) \[1, 6, 2\]",
        ),
        (
            "[recurrent]\nprev_tracks.first = 'none.npy'",
            "none.npy is neither zeros nor an input that is not recurrent; those",
        ),
        ("[recurrent]\nprev_time = { begin = 'zeros' }", r"adapter recurrent.prev_tim"),
    ],
)
def test_a_first_value_that_does_not_fit_is_one_line(
    tmp_path: Path, text: str, words: str
) -> None:
    with pytest.raises(EvaluationError, match=words) as caught:
        policy_of(tmp_path, counter(tmp_path), text)
    assert "\n" not in str(caught.value)
