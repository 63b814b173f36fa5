import dataclasses
import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from me2e_compress.evaluators.highway.runner import drive
from me2e_compress.metrics.episode import Ending
from tests.evaluators.highway.asked import observation, planned
from tests.evaluators.highway.drivers import EXIT, PARKED, straight_on

NORM = {"input": "img", "mean": [10, 20, 30], "std": [2, 4, 5], "order": "bgr"}
IMAGE = {"me2e.image": json.dumps(NORM)}


def test_a_model_drives(tmp_path: Path) -> None:
    policy = OnnxPolicy.open(straight_on(tmp_path / "m.onnx"))

    episode = drive(PARKED, policy, Drive())

    assert not policy.needs_images
    assert episode.failure is None
    assert len(episode.decisions) == len(episode.frames) - 1
    assert episode.frames[60].speed_mps == pytest.approx(4.0, abs=0.3)


def test_images_arrive_normalised_in_the_models_order(tmp_path: Path) -> None:
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[1, 6, 3, 16, 24] img",
        body="""
            flat = Reshape (img, everything)
            first = Gather <axis = 1> (flat, picked)
            plan = Reshape (first, plan_shape)""",
        initializers=""", int64[2] everything = {1, -1}, int64[12] picked = {
            0, 1, 384, 385, 768, 769, 1152, 1536, 1920, 6900, 6910, 6911},
            int64[3] plan_shape = {1, 6, 2}""",
        metadata=IMAGE,
    )
    policy, seen = OnnxPolicy.open(model), observation()
    policy.reset(EXIT)

    plan = planned(policy, seen)

    assert image_size_of(policy) == (16, 24)
    assert seen.images is not None
    blue_first = seen.images[..., ::-1].astype(float)
    expected = (blue_first - [10, 20, 30]) / [2, 4, 5]
    expected = np.moveaxis(expected, -1, 1).reshape(-1)
    picked = [0, 1, 384, 385, 768, 769, 1152, 1536, 1920, 6900, 6910, 6911]
    assert plan.reshape(-1) == pytest.approx(expected[picked], rel=1e-5)


VAD = """
axes = "right-forward"
[inputs]
lidar2img = "projection"
[plan]
output = "ego_fut_preds"
deltas = true
command_input = "command"
"""


def test_an_adapter_sums_steps_picks_the_mode_and_turns_the_axes(
    tmp_path: Path,
) -> None:
    """VAD's head: steps for three modes in the lidar frame, x right, y forward."""
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[6, 4, 4] projection",
        body="ego_fut_preds = Identity (steps)",
        outputs="float[1, 3, 6, 2] ego_fut_preds",
        initializers=", float[1, 3, 6, 2] steps = {"
        + ", ".join(["0.5, 0.0"] * 6 + ["0.0, 1.0"] * 6 + ["-0.25, 2.0"] * 6)
        + "}",
    )
    toml = tmp_path / "vad.toml"
    toml.write_text(VAD)
    policy = OnnxDriver(model, toml).open()
    policy.reset(EXIT)

    plan = planned(policy, observation(command=2))

    assert plan == pytest.approx(np.outer(range(1, 7), [2.0, 0.25]))
    assert planned(policy, observation(command=0))[5] == pytest.approx([0.0, -3.0])


@pytest.mark.parametrize(
    ("model", "words"),
    [
        ({"inputs": "float[1, 5, 4, 4] lidar2img"}, "lidar2img has shape [1, 5, 4, 4]"),
        ({"inputs": "float[2, 6, 4, 4] lidar2img"}, "it must be [1, 6, 4, 4]"),
        ({"inputs": "float[2] timestamp"}, "timestamp has shape [2], it must be [1]"),
        ({"inputs": "string[1] command"}, "it cannot be fed"),
        (
            {"outputs": "float[1, 6, 2] way", "body": "way = Identity (ahead)"},
            "no output plan",
        ),
        (
            {
                "outputs": "float[1, 3, 4] plan",
                "body": "plan = Reshape (ahead, shape)",
                "initializers": ", int64[3] shape = {1, 3, 4}",
            },
            "plan has shape [1, 3, 4], a plan is [1, n, 2]",
        ),
        (
            {
                "outputs": "float[1, 4, 2] plan",
                "body": "plan = Slice (ahead, from, to, axes)",
                "initializers": ", int64[1] from = {0}, int64[1] to = {4},"
                " int64[1] axes = {1}",
            },
            "the plan has shape [4, 2], it must be [6, 2]",
        ),
    ],
)
def test_a_model_that_breaks_the_contract_never_drives(
    tmp_path: Path, model: dict[str, str], words: str
) -> None:
    path = straight_on(tmp_path / "m.onnx", **model)  # type: ignore[arg-type]

    with pytest.raises(EvaluationError) as caught:
        OnnxDriver(path).open()
    message = str(caught.value)
    assert message.startswith(f"{path}: ")
    assert words in message
    assert "\n" not in message


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("[inputs]\npicture = 'img'", "adapter inputs.picture"),
        ("[plan]\noutput = 'way'", "no output way, which is named as the plan; there"),
        ("[inputs]\nimg = 'image'", "the adapter names input image; there are command"),
        ("[recurrent]\ncommand = 'x'", "the adapter names output x; there are plan"),
        ("axes = 'up'", "adapter axes"),
        ("axes =", "not TOML"),
    ],
)
def test_a_wrong_adapter_is_one_line(tmp_path: Path, text: str, words: str) -> None:
    path, toml = straight_on(tmp_path / "m.onnx"), tmp_path / "a.toml"
    toml.write_text(text)

    with pytest.raises(EvaluationError) as caught:
        OnnxDriver(path, toml).open()
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


def test_no_model_at_all(tmp_path: Path) -> None:
    (tmp_path / "m.onnx").write_bytes(b"not a model")

    with pytest.raises(EvaluationError, match=r"m.onnx: not an ONNX file"):
        OnnxDriver(tmp_path / "m.onnx").open()


def test_not_a_number_at_work_fails_the_route(tmp_path: Path) -> None:
    """The root of 9.5 minus the number of decisions, taken off itself."""
    model = straight_on(
        tmp_path / "m.onnx",
        inputs="float[1] count",
        outputs="float[1, 6, 2] plan, float[1] count_out",
        body="""
            count_out = Add (count, one)
            left = Sub (limit, count_out)
            root = Sqrt (left)
            zero = Sub (root, root)
            plan = Add (ahead, zero)""",
        initializers=", float[1] one = {1.0}, float[1] limit = {9.5}",
    )

    episode = drive(EXIT, OnnxPolicy.open(model), Drive())

    assert episode.ending is Ending.POLICY_FAILED
    assert episode.failure == "the plan is not finite"
    assert len(episode.decisions) == 9


# Models with a state: fed forward, reset with a route, told how much time passed.


COUNTER = {
    "inputs": "float[18] can_bus, float[1, 6, 2] steps",
    "body": "steps_out = Add (steps, one) plan = Identity (steps_out)",
    "outputs": "float[1, 6, 2] plan, float[1, 6, 2] steps_out",
    "initializers": ", float one = {1.0}",
}


def test_recurrent_state_is_fed_forward_and_reset(tmp_path: Path) -> None:
    policy = OnnxPolicy.open(straight_on(tmp_path / "m.onnx", **COUNTER))  # type: ignore[arg-type]
    counted = []
    for _ in range(2):
        policy.reset(EXIT)
        counted += [planned(policy, observation())[0, 0] for _ in range(3)]

    assert counted == [1.0, 2.0, 3.0, 1.0, 2.0, 3.0]


CLOCK = {
    "inputs": "float[1] timestamp, float[1] last",
    "body": """
        since = Sub (timestamp, last)
        plan = Add (zero, since)
        last_out = Identity (timestamp)""",
    "outputs": "float[1, 6, 2] plan, float[1] last_out",
    "initializers": ", float[1, 6, 2] zero = {" + ", ".join(["0.0"] * 12) + "}",
}


@pytest.mark.parametrize("name", ["timestamp", "seconds"])
def test_a_recurrent_model_knows_how_far_apart_its_frames_are(
    tmp_path: Path, name: str
) -> None:
    renamed = {key: text.replace("timestamp", name) for key, text in CLOCK.items()}
    path = straight_on(tmp_path / "m.onnx", **renamed)  # type: ignore[arg-type]
    policy = OnnxPolicy.open(path, Adapter(inputs={"timestamp": name}))
    elapsed = []
    for _ in range(2):
        policy.reset(EXIT)
        for time_us in (0, 350_000, 400_000):
            seen = dataclasses.replace(observation(), time_us=time_us)
            elapsed.append(planned(policy, seen)[0, 0])

    assert elapsed == pytest.approx([0.0, 0.35, 0.05] * 2)
