import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.camera_rig import CAMERA_NAMES, CameraRig

FRONT, BACK = CAMERA_NAMES.index("FRONT"), CAMERA_NAMES.index("BACK")


def pixel(
    rig: CameraRig, camera: int, point: tuple[float, float, float]
) -> npt.NDArray[np.float64]:
    u, v, depth, one = rig.lidar2img[camera].astype(float) @ (*point, 1.0)
    assert one == 1.0
    return np.array([u / depth, v / depth, depth])


def test_six_cameras_in_the_order_of_nuscenes() -> None:
    ahead = ("FRONT", "FRONT_LEFT", "FRONT_RIGHT")
    assert (*ahead, "BACK", "BACK_LEFT", "BACK_RIGHT") == CAMERA_NAMES
    assert CameraRig(96, 160).lidar2img.shape == (6, 4, 4)
    assert CameraRig(96, 160).lidar2img.dtype == np.float32


def test_a_point_ahead_at_camera_height_is_on_the_horizon_in_the_middle() -> None:
    rig = CameraRig(96, 160)
    u, v, depth = pixel(rig, FRONT, (11.5, 0.0, 1.6))
    np.testing.assert_allclose((u, v, depth), (80.0, 96 * 0.42, 10.0), atol=1e-4)


def test_left_of_the_car_is_left_ahead_and_right_behind() -> None:
    rig = CameraRig(96, 160)
    # the edge of the field of view is that of the image
    x, y = 1.5 + 10.0, 10.0 * np.tan(np.deg2rad(35.0))
    assert pixel(rig, FRONT, (x, y, 1.0))[0] == pytest.approx(0.0, abs=1e-3)
    assert pixel(rig, FRONT, (x, -y, 1.0))[0] == pytest.approx(160.0, abs=1e-3)
    assert pixel(rig, FRONT, (20.0, 2.0, 1.0))[0] < 80.0
    assert pixel(rig, BACK, (-20.0, 2.0, 1.0))[0] > 80.0


@given(
    st.sampled_from(range(6)),
    st.tuples(st.floats(-30, 30), st.floats(-30, 30), st.floats(0, 4)),
)
def test_lidar2img_is_k_times_r_and_t(camera: int, point: tuple[float, ...]) -> None:
    rig = CameraRig(128, 224)
    seen = rig.rotations[camera] @ (point - rig.positions[camera])
    expected = rig.intrinsics[camera] @ seen
    found = (rig.lidar2img[camera].astype(float) @ (*point, 1.0))[:3]
    np.testing.assert_allclose(found, expected, rtol=1e-4, atol=1e-2)


@given(st.floats(-np.pi, np.pi))
def test_whatever_stands_around_the_car_is_in_an_image(azimuth: float) -> None:
    rig = CameraRig(96, 160)
    point = (25 * np.cos(azimuth), 25 * np.sin(azimuth), 1.0)
    seen = [pixel(rig, camera, point) for camera in range(6)]
    assert any(depth > 0 and 0 <= u <= 160 for u, _, depth in seen)


@pytest.mark.parametrize(("height", "width"), [(8, 160), (96, 5000), (0, 0)])
def test_a_size_out_of_range_is_named(height: int, width: int) -> None:
    with pytest.raises(EvaluationError, match=r"camera (height|width) \d+ px .* 16 to"):
        CameraRig(height, width)
