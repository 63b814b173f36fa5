import json
from pathlib import Path

import numpy as np
import pytest

from me2e_compress.errors import FramesError, GraphError
from me2e_compress.zoo.cameras import HEIGHT, WIDTH, rig
from me2e_compress.zoo.frames import Frame, frames, write_frames
from me2e_compress.zoo.stacks import VAD_TINY
from me2e_compress.zoo.world import FRAME_S, Pose


def files(folder: Path) -> dict[str, bytes]:
    return {path.name: path.read_bytes() for path in sorted(folder.iterdir())}


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("zoo") / "frames"
    return write_frames("vad-tiny", path, 3, seed=4, scene_length=2)


def test_layout(folder: Path) -> None:
    assert list(files(folder)) == [
        "000000.npz",
        "000001.npz",
        "000002.npz",
        "scenes.json",
    ]
    assert json.loads((folder / "scenes.json").read_text()) == {
        "scenes": [0, 2],
        "stack": "vad-tiny",
        "seed": 4,
        "count": 3,
    }


def test_frames_are_the_inputs_without_the_state(folder: Path) -> None:
    with np.load(folder / "000001.npz") as frame:
        shapes = {name: (frame[name].shape, frame[name].dtype) for name in frame}
    assert shapes == {
        name: (shape, np.dtype(np.float32))
        for name, shape in VAD_TINY.inputs.items()
        if name not in VAD_TINY.recurrent
    }


def test_same_seed_same_bytes(folder: Path, tmp_path: Path) -> None:
    again = write_frames("vad-tiny", tmp_path / "f", 3, seed=4, scene_length=2)
    assert files(again) == files(folder)


def test_another_seed_another_world(scenes: list[Frame], folder: Path) -> None:
    with np.load(folder / "000000.npz") as frame:
        assert not np.array_equal(frame["img"], scenes[0]["img"])


def test_images_are_normalised_and_padded(scenes: list[Frame]) -> None:
    img = scenes[0]["img"]
    assert not img[..., HEIGHT:, :].any()
    seen = img[..., :HEIGHT, :]
    assert -2.2 < seen.min() < -1
    assert 1 < seen.max() < 2.7
    assert 0.5 < seen.std() < 1.5


def test_a_scene_is_coherent(scenes: list[Frame]) -> None:
    """The next frame looks more alike than another scene, yet is not the same."""
    one, following, other = (scenes[index]["img"] for index in (0, 1, 2))
    near = float(np.abs(one - following).mean())
    assert 0.05 < near < 0.8 * float(np.abs(one - other).mean())


def test_first_frame_of_a_scene_has_not_moved(scenes: list[Frame]) -> None:
    for index in (0, 2):
        bus = scenes[index]["can_bus"]
        assert not bus[0:3].any()
        assert bus[17] == 0


def test_can_bus_is_the_motion(scenes: list[Frame]) -> None:
    before, now = scenes[0]["can_bus"], scenes[1]["can_bus"]
    way = float(np.hypot(now[0], now[1]))
    assert way == pytest.approx((before[7] + now[7]) / 2 * FRAME_S, rel=1e-2)
    assert np.radians(now[17]) == pytest.approx(now[16] - before[16], abs=1e-6)
    assert np.linalg.norm(now[3:7]) == pytest.approx(1)


def test_lidar2img_follows_the_rays() -> None:
    """A point along the ray of a pixel projects back to its centre."""
    for camera in rig():
        rays = camera.rays()
        for row, column in ((10, 20), (HEIGHT - 1, WIDTH - 1)):
            point = camera.position + 7.5 * rays[row, column]
            u, v, depth, _ = camera.lidar2img() @ np.append(point, 1)
            assert depth == pytest.approx(7.5, rel=1e-4)
            assert u / depth == pytest.approx(column + 0.5, abs=0.01)
            assert v / depth == pytest.approx(row + 0.5, abs=0.01)


def test_front_camera_looks_ahead_and_left_is_left() -> None:
    for camera, point in ((0, (0, 20, 0)), (1, (-15, 10, 0)), (3, (0, -20, 0))):
        u, _, depth, _ = rig()[camera].lidar2img() @ np.array([*point, 1])
        assert depth > 5
        assert 0 < u / depth < WIDTH


def test_pose_round_trip() -> None:
    pose = Pose(3.0, -2.0, 0.7)
    right, ahead = np.array([1.5], np.float32), np.array([8], np.float32)
    back = pose.to_lidar(*pose.to_world(right, ahead))
    assert back[0] == pytest.approx(right, abs=1e-5)
    assert back[1] == pytest.approx(ahead, abs=1e-5)


def test_earlier_frames_are_replaced(tmp_path: Path) -> None:
    target = tmp_path / "frames"
    write_frames("vad-tiny", target, 2, seed=0)
    told: list[int] = []
    write_frames("vad-tiny", target, 1, seed=1, on_frame=told.append)
    assert list(files(target)) == ["000000.npz", "scenes.json"]
    assert told == [1]
    assert [path.name for path in tmp_path.iterdir()] == ["frames"]


@pytest.mark.parametrize("also", [(), ("scenes.json",)])
def test_foreign_folder_is_refused(tmp_path: Path, also: tuple[str, ...]) -> None:
    for name in ("thesis.tex", *also):
        (tmp_path / name).write_text("mine")
    with pytest.raises(FramesError, match=r"thesis\.tex"):
        write_frames("vad-tiny", tmp_path, 1, seed=0)
    assert (tmp_path / "thesis.tex").read_text() == "mine"


def test_a_file_is_not_a_folder(tmp_path: Path) -> None:
    path = tmp_path / "frames"
    path.write_text("mine")
    with pytest.raises(FramesError, match="is a file"):
        write_frames("vad-tiny", path, 1, seed=0)


def test_failure_leaves_nothing(tmp_path: Path) -> None:
    with pytest.raises(FramesError, match="must be >= 1"):
        write_frames("vad-tiny", tmp_path / "frames", 0, seed=0)
    assert list(tmp_path.iterdir()) == []


def test_unknown_stack(tmp_path: Path) -> None:
    with pytest.raises(GraphError, match="no stack 'tcp2'"):
        write_frames("tcp2", tmp_path / "frames", 1, seed=0)


def test_frames_of_a_scene_do_not_depend_on_those_before() -> None:
    """Scene 1 is the same whether scene 0 was 1 or 2 frames long."""
    short = list(frames(VAD_TINY, 2, seed=9, scene_length=1))[1]
    long = list(frames(VAD_TINY, 3, seed=9, scene_length=2))[2]
    assert np.array_equal(short["img"], long["img"])
