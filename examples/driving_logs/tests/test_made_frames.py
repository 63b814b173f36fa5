"""``me2e-compress frames --from``, with this package installed."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import NamedTuple

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.frames import record_frames
from me2e_compress.commands.options import FramesOptions
from small_logs import MAKERS, SPEED, car_at, pixel, seen_point, write_nuscenes

FRONT = """
front (float[1,1,3,H,80] img, float[1,1,4,4] lidar2img, float[1,2] prev_memory)
    => (float[1,1,3,H,80] plan, float[1,2] prev_memory_out)
{ plan = Relu(img) prev_memory_out = Relu(prev_memory) }
"""
UNIAD = """
uniad (float[1,6,3,256,416] img, float[1,6,4,4] lidar2img)
    => (float[1,6,3,256,416] plan)
{ plan = Relu(img) }
"""
MINE = """
mine (float[1,2,3,45,80] looks, float[1,2,4,4] where, float[1,1] pace, float[1,3] place,
      float[1,3,3] turn, float[1,6,2] before) => (float[1,6,2] way, float[1,6,2] after)
{ after = Add(before, pace) way = Identity(after) }
"""
ADAPTER = """
axes = "right-forward"

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


class Mine(NamedTuple):
    """A graph of one's own, and its adapter."""

    model: Path
    adapter: Path


@pytest.fixture
def mine(tmp_path: Path) -> Mine:
    np.save(tmp_path / "before.npy", np.ones((1, 6, 2), np.float32))
    (tmp_path / "a.toml").write_text(ADAPTER)
    return Mine(write_graph(tmp_path / "mine.onnx", MINE), tmp_path / "a.toml")


def write_graph(
    path: Path, text: str, metadata: Mapping[str, str] | None = None
) -> Path:
    model = ir.from_onnx_text(f'<ir_version: 9, opset_import: ["" : 17]>\n{text}')
    model.metadata_props.update(metadata or {})
    graph.save(model, path)
    return path


def made(
    model: Path, text: str, adapter: Path | None = None, count: int = 256
) -> CalibrationSet:
    options = FramesOptions(count=count, log=text, adapter=adapter)
    return CalibrationSet(record_frames(model, model.parent / "out", options))


def test_a_file_with_one_camera_sees_it_alone(tmp_path: Path) -> None:
    model = write_graph(tmp_path / "front.onnx", FRONT, {"me2e.image": IMAGE})
    root = write_nuscenes(tmp_path / "log", 1)

    (frame,) = made(model, f"nuscenes{{root={root},cameras=[CAM_FRONT],size=[48,80]}}")

    assert list(frame.arrays) == ["img", "lidar2img"]
    assert frame.arrays["img"][0, 0, :, 0, 0].tolist() == [-100, -110, -120]


def test_a_picture_takes_400_of_416_columns_of_uniad(tmp_path: Path) -> None:
    metadata = {"me2e.image": IMAGE, "me2e.stack": "uniad-trt"}
    model = write_graph(tmp_path / "uniad.onnx", UNIAD, metadata)
    root = write_nuscenes(tmp_path / "log", 1)

    recording = made(model, f"nuscenes:{root}")

    with np.load(recording.files[0]) as arrays:
        assert arrays["img"].shape == (1, 6, 3, 225, 400)


@pytest.mark.parametrize("name", MAKERS)
def test_a_log_feeds_what_the_adapter_says(mine: Mine, name: str) -> None:
    root = MAKERS[name](mine.model.parent / "log")

    first, second, *_ = made(mine.model, f"{name}:{root}", mine.adapter)

    arrays = first.arrays
    assert arrays["pace"][0, 0] == pytest.approx(SPEED, rel=0.01)
    assert arrays["before"].all()
    assert "before" not in second.arrays
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


def test_an_open_size_is_asked_for(tmp_path: Path) -> None:
    model = write_graph(tmp_path / "front.onnx", FRONT, {"me2e.image": IMAGE})
    root = write_nuscenes(tmp_path / "log", 1)

    with pytest.raises(FramesError, match=r"img is \[None, 80\], an open size: give"):
        made(model, f"nuscenes:{root}")


@pytest.mark.parametrize("option", ["cameras=[CAM_FRONT]", "size=[45,80]"])
def test_the_adapter_alone_says_what_the_model_sees(mine: Mine, option: str) -> None:
    root = write_nuscenes(mine.model.parent / "log", 1)

    with pytest.raises(FramesError, match="both say what the model sees"):
        made(mine.model, f"nuscenes{{root={root},{option}}}", mine.adapter)
