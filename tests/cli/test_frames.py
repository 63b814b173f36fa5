"""``frames --from``: recorded driving as the frames of a stack, or of any graph."""

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.zoo.stacks import UNIAD_TRT, VAD_TINY
from tests.calibration.logs.small_logs import (
    SPEED,
    car_at,
    pixel,
    seen_point,
    write_bench2drive,
    write_nuscenes,
)
from tests.command import Cli
from tests.nets import save_text
from tests.stacks import write_stack

FRONT = """
front (float[1,1,3,H,80] img, float[1,1,4,4] lidar2img, float[1,2] prev_memory)
    => (float[1,1,3,H,80] plan, float[1,2] prev_memory_out)
{ plan = Relu(img) prev_memory_out = Relu(prev_memory) }
"""
MINE = """
mine (float[1,2,3,45,80] looks, float[1,2,4,4] where, float[1,1] pace, float[1,3] place,
      float[1,3,3] turn, float[1,6,2] before) => (float[1,6,2] way, float[1,6,2] after)
{ after = Add(before, pace) way = Identity(after) }
"""
ADAPTER = """
axes = "AXES"

[images.looks]
cameras = ["FRONT", "BACK_LEFT"]
mean = [0.0, 0.0, 0.0]
std = [1.0, 1.0, 1.0]

[feeds]
where = { source = "lidar2img" }
pace = { source = "speed" }
place = { source = "l2g-translation" }
turn = { source = "l2g-rotation" }

[recurrent]
before = { from = "after", first = "before.npy" }

[plan]
output = "way"
"""
IMAGE = json.dumps({"mean": [100, 110, 120], "std": [1, 1, 1], "order": "bgr"})
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
PLANNER = """
planner (float[18] can_bus) => (float[1,6,2] plan)
<float[1,6,2] way = {0,3, 0,6, 0,9, 0,12, 0,15, 0,18}, float speed = {%s},
 int64[1] one = {1}, int64[1] two = {2}> {
    moved = Slice(can_bus, one, two)
    nothing = Sub(moved, moved)
    faster = Mul(way, speed)
    plan = Add(faster, nothing)
}
"""
LOGS = pytest.mark.parametrize(
    ("name", "write"),
    [("nuscenes", write_nuscenes), ("bench2drive", write_bench2drive)],
)
Write = Callable[[Path, int], Path]
NUSCENES = "--from nuscenes:log -o out"


@LOGS
def test_a_log_becomes_frames_of_vad(
    cli: Cli, tmp_path: Path, name: str, write: Write
) -> None:
    write(tmp_path / "log", 2)

    found = cli.document(f"frames vad-tiny --from {name}:log -o out")

    count = {"nuscenes": 2, "bench2drive": 1}[name]
    assert (found["frames"], found["seed"]) == (count, None)
    arrays = CalibrationSet(tmp_path / "out")[0].arrays
    image = arrays["img"].astype(float)
    assert {each: array.shape for each, array in arrays.items()} == {
        each: VAD_TINY.inputs[each] for each in ("img", "lidar2img", "can_bus")
    }
    black = -np.array(VAD_TINY.image.mean) / VAD_TINY.image.std
    np.testing.assert_allclose(image[0, 0, :, 0, 0], black, rtol=1e-5)
    assert not image[0, 0, :, 360:].any()


def test_a_file_with_one_camera_sees_it_alone(cli: Cli, tmp_path: Path) -> None:
    save_text(tmp_path / "front.onnx", FRONT, **{"me2e.image": IMAGE})
    root = write_nuscenes(tmp_path / "log", 1)
    log = f"nuscenes{{root={root},cameras=[CAM_FRONT],size=[48,80]}}"

    cli.done(f"frames front.onnx --from {log} -o out")

    frame = CalibrationSet(tmp_path / "out")[0]
    assert list(frame.arrays) == ["img", "lidar2img"]
    assert frame.arrays["img"][0, 0, :, 0, 0].tolist() == [-100, -110, -120]
    assert frame.future is not None
    assert frame.future.forward == pytest.approx(0.0)  # as the policy contract sees


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("tcp --from nuscenes:log", "input state is not made from a log"),
        ("front.onnx --from nuscenes:log", "img is [None, 80], an open size: give it"),
        ("vad-tiny --from kitti:log", "no driving log 'kitti'; there are nuscenes"),
        ("nothing --from nuscenes:log", "no stack 'nothing' in the zoo"),
        ("vad-tiny --from nuscenes:log --road 2", "--road 2: nobody drives for these"),
        ("vad-tiny --road 1", "--road 1: nobody drives for these frames"),
        ("highway --road 3", "--road 3: there are 1 and 2"),
        (
            "vad-tiny --from nuscenes:log --adapter a.toml",
            "name the ONNX file that it adapts",
        ),
        (
            "mine.onnx --adapter a.toml --from nuscenes{root=log,cameras=[CAM_FRONT]}",
            "cameras and the adapter's [images] both say",
        ),
        (
            "mine.onnx --adapter a.toml --from nuscenes{root=log,size=[45,80]}",
            "size and the adapter's [images] both say",
        ),
    ],
)
def test_what_does_not_fit_is_one_line(
    cli: Cli, mine: Path, words: str, message: str
) -> None:
    save_text(mine / "front.onnx", FRONT, **{"me2e.image": IMAGE})
    write_nuscenes(mine / "log", 1)

    assert message in cli.refused(f"frames {words} -o out")


def test_uniad_is_fed_all_that_it_takes(cli: Cli, tmp_path: Path) -> None:
    """Pictures of 400 x 225 in an input of 416 x 256."""
    write_nuscenes(tmp_path / "log", 1)

    cli.done(f"frames uniad-trt {NUSCENES}")

    recording = CalibrationSet(tmp_path / "out")
    arrays = recording[0].arrays
    wanted = {*UNIAD_TRT.inputs} - {*UNIAD_TRT.recurrent}
    shapes = {name: array.shape for name, array in arrays.items()}
    assert shapes == {name: UNIAD_TRT.inputs[name] for name in wanted}
    assert arrays["command"].dtype.kind == "i"
    with np.load(recording.files[0]) as held:
        assert held["img"].shape == (1, 6, 3, 225, 400)


def test_a_stack_of_several_files_is_fed_as_one_model(cli: Cli, tmp_path: Path) -> None:
    write_stack(tmp_path, backbone=BACKBONE, head=HEAD)
    backbone = graph.load(tmp_path / "backbone.onnx")
    backbone.metadata_props["me2e.image"] = IMAGE
    graph.save(backbone, tmp_path / "backbone.onnx")
    write_nuscenes(tmp_path / "log", 1)

    cli.done(f"frames stack.toml {NUSCENES}")

    assert {*CalibrationSet(tmp_path / "out")[0].arrays} == {"img", "can_bus"}


def test_plans_are_held_against_what_was_driven(cli: Cli, tmp_path: Path) -> None:
    """A plan straight on at the car's speed, and one that stands still."""
    write_nuscenes(tmp_path / "log", 8)
    for name, speed in (("go", 1), ("stand", 0)):
        file = tmp_path / f"{name}.onnx"
        save_text(file, PLANNER % speed, **{"me2e.stack": "vad-tiny"})
    cli.done(f"frames go.onnx {NUSCENES}")

    seen = cli.document("compare go.onnx stand.onnx out")["open_loop"]

    assert (seen["frames"], seen["scenes"], seen["left_out"]) == (2, 1, 6)
    at = {(q["measure"], q["horizon_s"]): q for q in seen["qualities"][::-1]}
    assert at["l2", 1]["candidate"] == pytest.approx(6.0, abs=0.1)
    # the lidar, 0.94 m ahead of the car, is 0.707 m to the left and 0.047 m behind
    assert at["l2", 1]["reference"] == pytest.approx(0.7084, abs=1e-4)
    assert at["collision", 3]["reference"] == 0


@pytest.fixture
def mine(tmp_path: Path) -> Path:
    """A folder with a graph of one's own, and adapters of two axes."""
    save_text(tmp_path / "mine.onnx", MINE)
    np.save(tmp_path / "before.npy", np.ones((1, 6, 2), np.float32))
    for name, axes in (("a", "right-forward"), ("mirror", "forward-right")):
        (tmp_path / f"{name}.toml").write_text(ADAPTER.replace("AXES", axes))
    return tmp_path


@LOGS
def test_a_log_feeds_what_the_adapter_says(
    cli: Cli, mine: Path, name: str, write: Write
) -> None:
    write(mine / "log", 8)

    cli.done(f"frames mine.onnx --from {name}:log --adapter a.toml -o out")

    frame = CalibrationSet(mine / "out")[0]
    arrays = frame.arrays
    assert arrays["pace"][0, 0] == pytest.approx(SPEED, rel=0.01)
    assert arrays["before"].all()
    for at, camera in enumerate(("CAM_FRONT", "CAM_BACK_LEFT")):
        world = (car_at(0).to_world @ seen_point(camera))[:3]
        point = (world - arrays["place"][0]) @ np.linalg.inv(arrays["turn"][0])
        u, v, depth, _ = arrays["where"][0, at] @ np.append(point, 1.0)
        assert depth > 0
        assert 2 * u / depth == pytest.approx(pixel(camera)[0], abs=0.1)
        assert 2 * v / depth == pytest.approx(pixel(camera)[1], abs=0.1)
        looks = arrays["looks"][0, at, 0]
        assert looks[round(v / depth), round(u / depth)] > 100
        assert (looks > 100).sum() < 20
    assert "before" not in CalibrationSet(mine / "out")[1].arrays
    assert frame.future is not None
    ahead = frame.future.waypoints[0]
    assert ahead is not None
    assert ahead[1] == pytest.approx(SPEED / 2, rel=0.05)  # y is forward


def test_no_future_is_kept_in_a_mirror(cli: Cli, mine: Path) -> None:
    write_nuscenes(mine / "log", 2)

    cli.done(f"frames mine.onnx --adapter mirror.toml {NUSCENES}")
    assert CalibrationSet(mine / "out")[0].future is None
