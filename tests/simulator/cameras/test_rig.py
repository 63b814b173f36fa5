import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.errors import EvaluationError
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


def test_left_of_the_car_is_left_ahead_and_right_behind() -> None:
    rig = CameraRig(96, 160)
    # a point at camera height is on the horizon, ahead in the middle
    seen = pixel(rig, FRONT, (11.5, 0.0, 1.6))
    np.testing.assert_allclose(seen, (80.0, 96 * 0.42, 10.0), atol=1e-4)
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
    seen = rig.rotations[camera] @ point + rig.translations[camera]
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


GRID = BirdseyeGrid(front_m=40.0, left_m=20.1, cell_m=0.2, rows=300, columns=201)


def at(texture: GroundTexture, scene: Scene, x: float, y: float) -> PixelClass:
    """Class of the cell that holds a point of the ego frame."""
    column, row = GRID.cells(np.array([x, y]))
    return PixelClass(int(bev_classes(scene, texture, GRID)[int(row), int(column)]))


@pytest.mark.parametrize(
    ("x", "y", "kind"),
    [
        (0.1, 0.1, PixelClass.EGO),
        (10.1, 3.6, PixelClass.VEHICLE),
        (8.1, -1.4, PixelClass.PEDESTRIAN),
        (-9.9, 0.1, PixelClass.STATIC),
        (5.1, 0.1, PixelClass.DRIVABLE),
        (5.1, -2.0, PixelClass.LANE_MARKING),
        (20.1, 3.1, PixelClass.STOP_LINE),
        (5.1, -8.1, PixelClass.TERRAIN),
    ],
)
def test_what_lies_where(
    texture: GroundTexture, x: float, y: float, kind: PixelClass
) -> None:
    scene = town.scene(
        town.actor(10.0, 4.0),
        town.actor(8.0, -1.5, ActorKind.PEDESTRIAN),
        town.actor(-10.0, 0.0, ActorKind.BARRIER),
    )
    assert at(texture, scene, x, y) is kind


def test_the_grid_turns_with_the_ego(texture: GroundTexture) -> None:
    # looking north from the lane at y = 0: the car to the east is on the right
    scene = town.scene(town.actor(10.0, 0.0), seen_from=town.ego(0.0, 0.0, np.pi / 2))
    assert at(texture, scene, 0.1, -10.1) is PixelClass.VEHICLE
    assert at(texture, scene, 15.1, 0.1) is PixelClass.TERRAIN
    assert at(texture, scene, 3.9, -15.1) is PixelClass.DRIVABLE


def test_a_crosswalk_is_seen_from_above_and_from_the_car(
    texture: GroundTexture, cameras: Cameras
) -> None:
    scene = town.scene(seen_from=town.ego(12.0, 2.0))
    assert (bev_classes(scene, texture, GRID) == PixelClass.CROSSWALK).sum() > 50
    assert (cameras.classes(scene) == PixelClass.CROSSWALK).sum() > 50


def test_ground_classes_of_camera_and_grid_agree(
    texture: GroundTexture, cameras: Cameras, rig: CameraRig
) -> None:
    scene = town.scene(seen_from=town.ego(3.0, 1.0, 0.2))
    labels, grid = cameras.classes(scene), bev_classes(scene, texture, GRID)
    rng = np.random.default_rng(0)
    same, asked = 0, 0
    for x, y in rng.uniform((4.0, -6.0), (15.0, 6.0), (400, 2)).tolist():
        u, v, depth, _ = rig.lidar2img[0].astype(float) @ (x, y, 0.0, 1.0)
        u, v = u / depth, v / depth
        if not (0 <= u < rig.width and 0 <= v < rig.height):
            continue
        column, row = GRID.cells(np.array([x, y]))
        asked += 1
        same += int(labels[0, int(v), int(u)] == grid[int(row), int(column)])
    assert asked > 200
    assert same / asked > 0.93


def test_an_empty_grid_is_refused() -> None:
    with pytest.raises(EvaluationError, match=r"grid of 0 x 200 cells .* positive"):
        BirdseyeGrid(rows=0)


def test_the_ground_is_what_lies_under_the_ego(texture: GroundTexture) -> None:
    scene = town.scene()
    seen = bev_classes(scene, texture, GRID)

    ground = ground_classes(scene.ego, texture, GRID)

    ego = seen == PixelClass.EGO
    assert np.array_equal(ground[~ego], seen[~ego])
    assert np.all(ground[ego] == PixelClass.DRIVABLE)


@pytest.mark.parametrize("turn", [0.0, 0.7, 2.0])
def test_nobody_is_skipped_who_touches_the_edge(
    texture: GroundTexture, turn: float
) -> None:
    small = BirdseyeGrid(8.0, 6.0, 1.0, 16, 12)
    ego = replace(town.scene().ego, heading=turn)
    found = list[bool]()
    for x in range(-13, 14):
        for y in range(-11, 12):
            car = replace(town.actor(0.0, 0.0), x=ego.x + x, y=ego.y + y)
            painted = bev_classes(replace(town.scene(car), ego=ego), texture, small)
            touched = covered([car], ego, small)
            wanted = painted == PixelClass.VEHICLE
            rest = painted != PixelClass.EGO
            assert np.array_equal(touched & rest, wanted), (x, y)
            found.append(bool(touched.any()))
    assert 0.2 < np.mean(found) < 0.8
