import numpy as np
import pytest

from me2e_compress.base.errors import FramesError
from models.stacks import VAD_TINY
from models.synthetic_cameras import HEIGHT, WIDTH, rig
from models.synthetic_frames import Frame, frames
from models.synthetic_world import FRAME_S, EgoPose


def test_frames_are_the_inputs_without_the_state(scenes: list[Frame]) -> None:
    shapes = {name: (array.shape, array.dtype) for name, array in scenes[0].items()}
    assert shapes == {
        name: (shape, np.dtype(np.float32))
        for name, shape in VAD_TINY.inputs.items()
        if name not in VAD_TINY.recurrent
    }


def test_a_scene_is_of_its_seed_whatever_was_made_before(scenes: list[Frame]) -> None:
    (first,) = frames(VAD_TINY, 1, seed=7, scene_length=2)
    third = next(frames(VAD_TINY, 3, seed=7, scene_length=2, first=2))
    for again, before in ((first, scenes[0]), (third, scenes[2])):
        for name, array in before.items():
            np.testing.assert_array_equal(again[name], array)
    (other,) = frames(VAD_TINY, 1, seed=4, scene_length=2)
    assert not np.array_equal(other["img"], scenes[0]["img"])
    # nor does scene 1 depend on whether scene 0 was 1 or 2 frames long
    short = list(frames(VAD_TINY, 2, seed=7, scene_length=1))[1]
    np.testing.assert_array_equal(short["img"], scenes[2]["img"])


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
    pose = EgoPose(3.0, -2.0, 0.7)
    right, ahead = np.array([1.5], np.float32), np.array([8], np.float32)
    back = pose.to_lidar(*pose.to_world(right, ahead))
    assert back[0] == pytest.approx(right, abs=1e-5)
    assert back[1] == pytest.approx(ahead, abs=1e-5)


@pytest.mark.parametrize(("count", "length"), [(0, 8), (4, 0)])
def test_no_frames_are_an_error(count: int, length: int) -> None:
    with pytest.raises(FramesError, match="must be at least 1"):
        list(frames(VAD_TINY, count, seed=0, scene_length=length))
