"""A stack of several files, wherever a model is asked for."""

from pathlib import Path

import numpy as np
import pytest

import me2e_compress as me2e
from me2e_compress.driving.answer import checked
from me2e_compress.driving.contract import Observation, Trajectory
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.errors import EvaluationError, FramesError, GraphError
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.stack.split_stack import digest_of_files
from me2e_compress.simulator.cameras import CameraRig
from me2e_compress.zoo.shipped import shipped
from tests.frames import record
from tests.stacks import HEAD, TWO_PARTS, take_apart, write_stack

NECK = ("/neck/Add_output_0", "/neck/Add_1_output_0")
"""Where the driver that ships is cut: what its neck gives."""


@pytest.fixture(scope="module")
def halves(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the TOML of the driver that ships, taken apart behind its neck."""
    return take_apart(shipped("highway"), NECK, tmp_path_factory.mktemp("halves"))


def recording(folder: Path, scenes: tuple[int, ...] = (0, 3)) -> Path:
    """Write five frames of images for the small stack."""
    images = np.random.default_rng(0).standard_normal((5, 1, 4)).astype(np.float32)
    return record(folder / "frames", [{"img": each} for each in images], scenes)


def decided(model: Path) -> list[object]:
    """Return three plans of a driver from the start of a route."""
    policy, rig = OnnxPolicy.open(model), CameraRig(96, 160)
    policy.reset(None)
    random = np.random.default_rng(0)
    plans = list[object]()
    for step in range(3):
        seen = Observation(
            50_000 * step,
            random.integers(0, 256, (6, 96, 160, 3)).astype(np.uint8),
            rig.lidar2img,
            random.normal(size=18).astype(np.float32),
            2,
            5.0,
        )
        answer = checked(policy.plan(seen))
        assert isinstance(answer, Trajectory)
        plans.append(answer.points.tolist())
    return plans


def test_the_driver_in_two_files_decides_as_the_whole(halves: Path) -> None:
    assert decided(halves) == decided(shipped("highway"))


def test_what_drives_is_known_by_all_of_its_files(tmp_path: Path) -> None:
    path = write_stack(tmp_path)

    assert OnnxDriver(path).fingerprint() == digest_of_files(path)


def test_compare_refuses_frames_that_lack_what_no_part_gives(tmp_path: Path) -> None:
    loose = HEAD.replace("float[1,4] prev_bev)", "float[1,4] prev_bev, float[1] speed)")
    path = write_stack(tmp_path, head=loose)

    with pytest.raises(
        FramesError, match=r"000000\.npz: speed is missing; there is img"
    ):
        me2e.compare(path, path, recording(tmp_path))


def test_profile_times_all_files_together(tmp_path: Path) -> None:
    path, trace = write_stack(tmp_path), tmp_path / "trace.json"

    me2e.profile(path, recording(tmp_path), trace)

    found = LatencyTrace.load(trace)
    assert len(found.samples_us) == 5
    assert found.model_sha256 == digest_of_files(path)


def test_profile_by_module_asks_for_one_file(tmp_path: Path) -> None:
    with pytest.raises(EvaluationError, match="profile one of its files"):
        me2e.profile(
            write_stack(tmp_path),
            recording(tmp_path),
            options=me2e.ProfileOptions(by_module=True),
        )


def test_what_takes_one_graph_says_so(tmp_path: Path) -> None:
    path = write_stack(tmp_path, TWO_PARTS)

    with pytest.raises(GraphError, match=r"stack\.toml: a TOML file; .* one of them"):
        me2e.lint(path)
