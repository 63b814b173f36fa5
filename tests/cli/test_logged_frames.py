"""``frames --from``: recorded driving as the frames of a stack or a file."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.zoo.stacks import UNIAD_TRT, VAD_TINY
from tests.calibration.logs.small_logs import write_bench2drive, write_nuscenes
from tests.cli.conftest import Command, strict
from tests.docs.documents import faults
from tests.stacks import write_stack

FRONT = """
<ir_version: 9, opset_import: ["" : 17]>
front (float[1,1,3,H,80] img, float[1,1,4,4] lidar2img, float[1,2] prev_memory)
    => (float[1,1,3,H,80] plan, float[1,2] prev_memory_out)
{
    plan = Relu(img)
    prev_memory_out = Relu(prev_memory)
}
"""
IMAGE = {"mean": [100, 110, 120], "std": [1, 1, 1], "order": "bgr"}


@pytest.fixture
def front(tmp_path: Path) -> Path:
    model = ir.from_onnx_text(FRONT)
    model.metadata_props["me2e.image"] = json.dumps(IMAGE)
    graph.save(model, tmp_path / "front.onnx")
    return tmp_path / "front.onnx"


@pytest.mark.parametrize(
    ("name", "write"),
    [("nuscenes", write_nuscenes), ("bench2drive", write_bench2drive)],
)
def test_a_log_becomes_frames_of_vad(
    command: Command,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    name: str,
    write: Callable[[Path, int], Path],
) -> None:
    log = f"{name}:{write(tmp_path / 'log', 2)}"
    words = ("frames", "vad-tiny", "--from", log, "-o", tmp_path / "out", "--json")

    assert command(*words) == 0

    found = strict(capsys.readouterr().out)
    assert faults("frames", found) == []
    count = {"nuscenes": 2, "bench2drive": 1}[name]
    assert (found["frames"], found["seed"]) == (count, None)
    recording = CalibrationSet(tmp_path / "out")
    arrays = recording[0].arrays
    image = arrays["img"].astype(float)
    assert {each: array.shape for each, array in arrays.items()} == {
        each: VAD_TINY.inputs[each] for each in ("img", "lidar2img", "can_bus")
    }
    black = -np.array(VAD_TINY.image.mean) / VAD_TINY.image.std
    np.testing.assert_allclose(image[0, 0, :, 0, 0], black, rtol=1e-5)
    assert not image[0, 0, :, 360:].any()


def test_a_file_with_one_camera_sees_it_alone(
    command: Command, tmp_path: Path, front: Path
) -> None:
    root = write_nuscenes(tmp_path / "log", 1)
    log = f"nuscenes{{root={root}, cameras=[CAM_FRONT], size=[48, 80]}}"

    assert command("frames", front, "--from", log, "-o", tmp_path / "out") == 0

    frame = CalibrationSet(tmp_path / "out")[0]
    assert list(frame.arrays) == ["img", "lidar2img"]
    assert frame.arrays["img"][0, 0, :, 0, 0].tolist() == [-100, -110, -120]
    assert frame.future is not None
    assert frame.future.forward == pytest.approx(0.0)  # as the policy contract sees


@pytest.mark.parametrize(
    ("model", "log", "message"),
    [
        ("tcp", "nuscenes:{root}", "input state is not made from a log"),
        ("front.onnx", "nuscenes:{root}", "img is [None, 80], an open size: give it"),
        ("vad-tiny", "kitti:{root}", "no driving log 'kitti'; there are nuscenes"),
        ("nothing", "nuscenes:{root}", "no stack 'nothing' in the zoo"),
    ],
)
def test_what_does_not_fit_is_one_line(
    command: Command,
    tmp_path: Path,
    front: Path,
    capsys: pytest.CaptureFixture[str],
    model: str,
    log: str,
    message: str,
) -> None:
    root = write_nuscenes(tmp_path / "log", 1)
    stack = front if model == front.name else model
    words = ("--from", log.format(root=root), "-o", tmp_path / "out")

    assert command("frames", stack, *words) == 1

    shown = " ".join(capsys.readouterr().err.split())
    assert message in shown
    assert not (tmp_path / "out").exists()


def test_uniad_is_fed_all_that_it_takes(command: Command, tmp_path: Path) -> None:
    """Pictures of 400 x 225 in an input of 416 x 256."""
    log = f"nuscenes:{write_nuscenes(tmp_path / 'log', 1)}"

    assert command("frames", "uniad-trt", "--from", log, "-o", tmp_path / "out") == 0

    recording = CalibrationSet(tmp_path / "out")
    arrays = recording[0].arrays
    wanted = {*UNIAD_TRT.inputs} - {*UNIAD_TRT.recurrent}
    shapes = {name: array.shape for name, array in arrays.items()}
    assert shapes == {name: UNIAD_TRT.inputs[name] for name in wanted}
    assert arrays["command"].dtype.kind == "i"
    with np.load(recording.files[0]) as held:
        assert held["img"].shape == (1, 6, 3, 225, 400)


BACKBONE = """
<ir_version: 9, opset_import: ["" : 17]>
backbone (float[1,6,3,48,80] img) => (float[1,6,3,48,80] feats)
{ feats = Relu(img) }
"""
HEAD = """
<ir_version: 9, opset_import: ["" : 17]>
head (float[1,6,3,48,80] feats, float[18] can_bus, float[1,6,3,48,80] prev_bev)
    => (float[1,6,3,48,80] next_bev, float[18] plan)
{ next_bev = Add(feats, prev_bev) plan = Identity(can_bus) }
"""


def test_a_stack_of_several_files_is_fed_as_one_model(
    command: Command, tmp_path: Path
) -> None:
    stack = write_stack(tmp_path, backbone=BACKBONE, head=HEAD)
    backbone = graph.load(tmp_path / "backbone.onnx")
    backbone.metadata_props["me2e.image"] = json.dumps(IMAGE)
    graph.save(backbone, tmp_path / "backbone.onnx")
    log = f"nuscenes:{write_nuscenes(tmp_path / 'log', 1)}"

    assert command("frames", stack, "--from", log, "-o", tmp_path / "out") == 0

    assert {*CalibrationSet(tmp_path / "out")[0].arrays} == {"img", "can_bus"}


PLANNER = """
<ir_version: 9, opset_import: ["" : 17]>
planner (float[18] can_bus) => (float[1,6,2] plan)
<float[1,6,2] way = {0,3, 0,6, 0,9, 0,12, 0,15, 0,18}, float speed = {%s},
 int64[1] one = {1}, int64[1] two = {2}> {
    moved = Slice(can_bus, one, two)
    nothing = Sub(moved, moved)
    faster = Mul(way, speed)
    plan = Add(faster, nothing)
}
"""


def test_plans_are_held_against_what_was_driven(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """A plan straight on at the car's speed, and one that stands still."""
    root = write_nuscenes(tmp_path / "log", 8)
    for name, speed in (("go", 1), ("stand", 0)):
        model = ir.from_onnx_text(PLANNER % speed)
        model.metadata_props["me2e.stack"] = "vad-tiny"
        graph.save(model, tmp_path / f"{name}.onnx")
    frames, log = tmp_path / "frames", f"nuscenes:{root}"
    models = tmp_path / "go.onnx", tmp_path / "stand.onnx"
    assert command("frames", models[0], "--from", log, "-o", frames) == 0
    capsys.readouterr()

    assert command("compare", *models, frames, "--json") == 0

    found = strict(capsys.readouterr().out)
    assert faults("compare", found) == []
    seen = found["open_loop"]
    assert (seen["frames"], seen["scenes"], seen["left_out"]) == (2, 1, 6)
    at = {(q["measure"], q["horizon_s"]): q for q in seen["qualities"][::-1]}
    assert at["l2", 1]["candidate"] == pytest.approx(6.0, abs=0.1)
    # the lidar, 0.94 m ahead of the car, is 0.707 m to the left and 0.047 m behind
    assert at["l2", 1]["reference"] == pytest.approx(0.7084, abs=1e-4)
    assert at["collision", 3]["reference"] == 0
