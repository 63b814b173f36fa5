"""``frames --from --adapter``: recorded driving as a graph of one's own is fed."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from tests.calibration.logs.small_logs import (
    SPEED,
    car_at,
    pixel,
    seen_point,
    write_bench2drive,
    write_nuscenes,
)
from tests.cli.conftest import Command

MINE = """
<ir_version: 9, opset_import: ["" : 17]>
mine (float[1,2,3,45,80] looks, float[1,2,4,4] where, float[1,1] pace, float[1,3] place,
      float[1,3,3] turn, float[1,6,2] before) => (float[1,6,2] way, float[1,6,2] after)
{
    after = Add(before, pace)
    way = Identity(after)
}
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
Write = Callable[[Path, int], Path]
LOGS = pytest.mark.parametrize(
    ("name", "write"),
    [("nuscenes", write_nuscenes), ("bench2drive", write_bench2drive)],
)


@pytest.fixture
def record(command: Command, tmp_path: Path) -> Callable[[str], int]:
    graph.save(ir.from_onnx_text(MINE), tmp_path / "mine.onnx")
    np.save(tmp_path / "before.npy", np.ones((1, 6, 2), np.float32))

    def run(log: str, axes: str = "right-forward") -> int:
        (tmp_path / "a.toml").write_text(ADAPTER.replace("AXES", axes))
        named = ("--from", log, "--adapter", tmp_path / "a.toml")
        return command("frames", tmp_path / "mine.onnx", *named, "-o", tmp_path / "out")

    return run


@LOGS
def test_a_log_feeds_what_the_adapter_says(
    record: Callable[[str], int], tmp_path: Path, name: str, write: Write
) -> None:
    assert record(f"{name}:{write(tmp_path / 'log', 8)}") == 0

    frame = CalibrationSet(tmp_path / "out")[0]
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
    assert "before" not in CalibrationSet(tmp_path / "out")[1].arrays
    assert frame.future is not None
    ahead = frame.future.waypoints[0]
    assert ahead is not None
    assert ahead[1] == pytest.approx(SPEED / 2, rel=0.05)  # y is forward


def test_no_future_is_kept_in_a_mirror(
    record: Callable[..., int], tmp_path: Path
) -> None:
    log = f"nuscenes:{write_nuscenes(tmp_path / 'log', 2)}"

    assert record(log, "forward-right") == 0
    assert CalibrationSet(tmp_path / "out")[0].future is None


@pytest.mark.parametrize(
    ("option", "why"),
    [
        ("cameras=[CAM_FRONT]", "cameras and the adapter's [images] both say"),
        ("size=[45, 80]", "size and the adapter's [images] both say"),
    ],
)
def test_what_the_cameras_show_is_said_once(
    record: Callable[[str], int],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    option: str,
    why: str,
) -> None:
    root = write_nuscenes(tmp_path / "log", 2)

    assert record(f"nuscenes{{root={root}, {option}}}") == 1
    assert why in capsys.readouterr().err


def test_a_stack_of_the_zoo_takes_no_adapter(
    command: Command, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "a.toml").write_text(ADAPTER.replace("AXES", "right-forward"))
    log = f"nuscenes:{write_nuscenes(tmp_path / 'log', 2)}"
    words = ("--from", log, "--adapter", tmp_path / "a.toml", "-o", tmp_path / "out")

    assert command("frames", "vad-tiny", *words) == 1
    assert "name the ONNX file that it adapts" in capsys.readouterr().err
