import numpy as np
import pytest

from bench2drive_agent.sensors import Pictures, specs
from me2e_compress.driving.adapter import Axes

LIDAR_M = (-0.39, 0.0, 1.84)
FULL = Pictures((900, 1600), 0, (0, 0, 0))

ZOO = {
    0: [
        [1142.51841, 800, 0, -952],
        [0, 450, -1142.51841, -809.704417],
        [0, 1, 0, -1.19],
    ],
    1: [
        [0, 1394.75744, 0, -920.539908],
        [-368.61842, 258.109396, -1142.51841, -647.29675],
        [-0.819152044, 0.573576436, 0, -0.829094072],
    ],
    3: [
        [-560.166031, -800, 0, -1288],
        [0, -450, -560.166031, -858.939847],
        [0, -1, 0, -1.61],
    ],
    5: [
        [360.989788, -1347.23223, 0, -104.238127],
        [422.861679, -153.909064, -1142.51841, -496.004706],
        [0.939692621, -0.342020143, 0, -0.492889531],
    ],
}
"""``lidar2img`` that Bench2DriveZoo's VAD agent has written down, by camera."""


@pytest.mark.parametrize("camera", ZOO)
def test_cameras_project_as_bench2drives_agents_have_it(camera: int) -> None:
    found = Axes.RIGHT_FORWARD.projection(FULL.lidar2img(LIDAR_M))[camera]

    np.testing.assert_allclose(found[:3], ZOO[camera], atol=1e-3)


def test_a_picture_is_scaled_as_a_whole_and_padded_below() -> None:
    small = Pictures((384, 640), 0, (0, 0, 0))
    point = np.array([12.0, 1.0, 0.5, 1.0])  # ahead, to the left

    u, v, depth, _ = small.lidar2img((0.0, 0.0, 0.0))[0] @ point
    wide_u, wide_v, _, _ = FULL.lidar2img((0.0, 0.0, 0.0))[0] @ point

    assert small.scale == 0.4
    assert depth == pytest.approx(12.0 - 0.8)
    assert (u, v) == pytest.approx((0.4 * wide_u, 0.4 * wide_v), rel=1e-5)
    assert u / depth < 320  # left of the middle
    assert 180 < v / depth < 360  # below the horizon


def test_the_sensors_keep_the_leaderboards_limits() -> None:
    found = specs(range(6))

    kinds = [each["type"] for each in found]
    assert kinds.count("sensor.camera.rgb") == 6
    assert len({each["id"] for each in found}) == len(found) == 9
    assert specs(()) == found[6:]
