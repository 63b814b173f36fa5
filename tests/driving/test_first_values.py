"""What recurrent inputs hold where a route begins."""

from pathlib import Path

import numpy as np
import pytest

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving.adapter import Adapter
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.workflows.frames import record_frames
from me2e_compress.workflows.options import FramesOptions
from tests.driving.observed import motion, observation
from tests.evaluators.highway.drivers import straight_on

NOW = motion(0.0, 0.0, 0.0)


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


FILE_AND_INPUT = """
[recurrent]
prev_tracks = { first = "queries.npz" }
prev_time = { from = "next_time", first = "timestamp" }
"""


def queries(folder: Path, shape: tuple[int, ...] = (6, 2)) -> None:
    np.savez(folder / "queries.npz", prev_tracks=np.full(shape, 5.0), other=np.ones(3))


def answers(policy: OnnxPolicy, times_us: tuple[int, ...]) -> list[float]:
    plans = [policy.plan(observation(NOW, time_us)) for time_us in times_us]
    return [float(np.asarray(plan.points)[3, 1]) for plan in plans]  # type: ignore[union-attr]


def test_a_route_begins_with_a_file_beside_the_adapter_and_another_input(
    tmp_path: Path,
) -> None:
    queries(tmp_path)
    policy = policy_of(tmp_path, counter(tmp_path), FILE_AND_INPUT)
    policy.reset(None)

    assert answers(policy, (2_000_000, 2_500_000)) == [5.0, 6.5]
    policy.reset(None)
    assert answers(policy, (7_000_000,)) == [5.0]


def test_recorded_scenes_begin_so_too(tmp_path: Path) -> None:
    queries(tmp_path)
    model, toml = counter(tmp_path), tmp_path / "a.toml"
    toml.write_text(FILE_AND_INPUT)
    options = FramesOptions(count=4, adapter=toml, scene_length=2)

    folder = record_frames(model, tmp_path / "frames", options)

    found = [frame.arrays for frame in CalibrationSet(folder)]
    assert [sorted(each) for each in found] == [
        ["prev_time", "prev_tracks", "timestamp"],
        ["timestamp"],
    ] * 2
    assert (found[2]["prev_tracks"] == 5.0).all()


def test_another_file_is_another_driver(tmp_path: Path) -> None:
    model, toml = counter(tmp_path), tmp_path / "a.toml"
    toml.write_text(FILE_AND_INPUT)
    queries(tmp_path)
    before = OnnxDriver(model, toml).fingerprint()
    np.savez(tmp_path / "queries.npz", prev_tracks=np.zeros((6, 2)))

    assert OnnxDriver(model, toml).fingerprint() != before


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
        (
            "[recurrent]\nprev_time = { first = 'speed' }",
            "first value of prev_time: speed is none of zeros, a file .npy or .npz",
        ),
        (
            "[recurrent]\nprev_tracks = { first = 'timestamp' }",
            r"is tensor\(float\) \[1\], the input takes tensor\(float\) \[1, 6, 2\]",
        ),
        ("[recurrent]\nprev_tracks.first = 'none.npy'", "none.npy cannot be read"),
        (
            "[recurrent]\nprev_time = { first = 'queries.npz' }",
            "queries.npz holds no array prev_time",
        ),
        (
            "[recurrent]\nprev_tracks = { first = 'queries.npz' }",
            r"has shape \[5, 2\], the input takes \[1, 6, 2\]",
        ),
        (
            "[recurrent]\nprev_time = { begin = 'zeros' }",
            r"adapter recurrent.prev_time.begin",
        ),
    ],
)
def test_a_first_value_that_does_not_fit_is_one_line(
    tmp_path: Path, text: str, words: str
) -> None:
    queries(tmp_path, (5, 2))
    with pytest.raises(EvaluationError, match=words) as caught:
        policy_of(tmp_path, counter(tmp_path), text)
    assert "\n" not in str(caught.value)
