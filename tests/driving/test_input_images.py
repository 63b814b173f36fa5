import dataclasses
import math
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.adapter.image_inputs import (
    CAMERA_NAMES,
    ImageInput,
    ImageNormalization,
    ImagePort,
    InputImages,
    rendered_size,
)
from me2e_compress.driving.input_sources import INPUT_SOURCES, Axes
from me2e_compress.simulator.camera_rig import CAMERA_NAMES as RIG_NAMES
from me2e_compress.simulator.camera_rig import CameraRig
from me2e_compress.testing import check_form
from tests.driving.observed import RIG, observed, value

ROWS, COLUMNS = 18, 32
IMAGES = np.random.default_rng(0).integers(0, 256, (6, ROWS, COLUMNS, 3), np.uint8)
NORM = ImageNormalization(mean=(10, 20, 30), std=(2, 4, 5), order="rgb")
TCP = {
    "cameras": ["FRONT_LEFT", "FRONT", "FRONT_RIGHT"],
    "camera_size": [900, 1600],
    "rendered": [288, 512],
    "crop": [[0, 0, 1400, 900], [200, 0, 1400, 900], [200, 0, 1600, 900]],
    "stitch": True,
    "size": [256, 900],
}
TWO, SMALL = {"cameras": ["FRONT", "BACK"]}, {"camera_size": [9, 16]}


def images_of(
    table: dict[str, Any],
    shape: tuple[int, ...],
    norm: ImageNormalization | None = None,
) -> InputImages:
    read = ImageInput.model_validate(table)
    port = ImagePort.of("img", shape, read)
    made = InputImages(read, port, rendered_size("img", read, port), norm)
    made.check("img")
    return made


chosen = st.lists(st.sampled_from(CAMERA_NAMES), min_size=1, max_size=6)


@given(
    cameras=chosen,
    left=st.integers(0, 15),
    width=st.integers(1, 16),
    top=st.integers(0, 8),
    height=st.integers(1, 9),
)
def test_a_crop_that_is_not_resized_keeps_every_pixel(
    cameras: list[str], left: int, width: int, top: int, height: int
) -> None:
    crop = {"crop": [[left, top, left + width, top + height]], "layout": "bnhwc"}
    table = {"cameras": cameras, "camera_size": [ROWS, COLUMNS], **crop}

    result = images_of(table, (1, len(cameras), height, width, 3)).apply(IMAGES)

    for at, name in enumerate(cameras):
        whole = IMAGES[CAMERA_NAMES.index(name)]
        expected = whole[top : top + height, left : left + width]
        np.testing.assert_array_equal(result[0, at], expected)


@given(cameras=chosen, lefts=st.lists(st.integers(0, 15), min_size=6, max_size=6))
def test_a_strip_that_is_not_resized_keeps_every_pixel(
    cameras: list[str], lefts: list[int]
) -> None:
    crops = [[at, 2, COLUMNS - at, 12] for at, _ in zip(lefts, cameras, strict=False)]
    width = sum(right - left for left, _, right, _ in crops)
    table = {"cameras": cameras, "crop": crops, "stitch": True, "layout": "hwc"}
    made = images_of({**table, "camera_size": [ROWS, COLUMNS]}, (10, width, 3))

    result, begin = made.apply(IMAGES), 0

    for name, (left, _, right, _) in zip(cameras, crops, strict=True):
        part = result[:, begin : begin + right - left]
        whole = IMAGES[CAMERA_NAMES.index(name)]
        np.testing.assert_array_equal(part, whole[2:12, left:right])
        begin += right - left


@given(
    cameras=chosen,
    crop=st.booleans(),
    stitch=st.booleans(),
    size=st.tuples(st.integers(5, 40), st.integers(5, 60)),
)
def test_a_point_projects_to_the_pixel_that_shows_it(
    cameras: list[str], crop: bool, stitch: bool, size: tuple[int, int]
) -> None:
    """Where a picture's pixel goes, its projection goes, too."""
    table: dict[str, Any] = {"cameras": cameras, "stitch": stitch, "size": list(size)}
    table["camera_size"] = [ROWS, COLUMNS]
    if crop:
        table["crop"] = [[4, 2, 28, 16]]
    shape = (1, 3, *size) if stitch else (1, len(cameras), 3, *size)
    lidar2img = CameraRig(ROWS, COLUMNS).lidar2img
    point = np.array([7.0, 3.0, 1.0, 1.0])

    result = images_of(table, shape).projections(lidar2img) @ point

    left, top, right, bottom = (4, 2, 28, 16) if crop else (0, 0, COLUMNS, ROWS)
    joined = len(cameras) if stitch else 1
    for at, name in enumerate(cameras):
        u, v, depth, _ = lidar2img[CAMERA_NAMES.index(name)] @ point
        before = at * (right - left) if stitch else 0
        across = (u / depth - left + before) * size[1] / ((right - left) * joined)
        down = (v / depth - top) * size[0] / (bottom - top)
        assert result[at, :2] / result[at, 2] == pytest.approx((across, down), rel=1e-3)


@pytest.mark.parametrize(
    ("layout", "shape"),
    [
        ("bnchw", (1, 6, 3, ROWS, COLUMNS)),
        ("nhwc", (6, ROWS, COLUMNS, 3)),
        ("bhwnc", (1, ROWS, COLUMNS, 6, 3)),
        ("cnhw", (3, 6, ROWS, COLUMNS)),
    ],
)
def test_dimensions_stand_as_the_layout_says(
    layout: str, shape: tuple[int, ...]
) -> None:
    result = images_of({"layout": layout}, shape, NORM).apply(IMAGES)

    assert result.shape == shape
    index = {"b": 0, "n": 4, "c": 2, "h": 5, "w": 7}
    pixel = result[tuple(index[letter] for letter in layout)]
    assert pixel == pytest.approx((float(IMAGES[4, 5, 7, 2]) - 30) / 5)


def test_bytes_stay_bytes_in_the_models_order() -> None:
    table = {"cameras": ["BACK"], "order": "bgr", "layout": "hwc"}

    result = images_of(table, (ROWS, COLUMNS, 3)).apply(IMAGES)

    assert result.dtype == np.uint8
    np.testing.assert_array_equal(result, IMAGES[3][..., ::-1])


def test_mean_and_std_of_zero_to_one_are_those_of_grey_levels() -> None:
    part = {"mean": [0.485, 0.456, 0.406], "std": [0.229, 0.224, 0.225]}
    table = ImageInput.model_validate({**part, "scale": 1 / 255})
    grey = {key: tuple(255 * value for value in result) for key, result in part.items()}

    result = table.normalization("img", None)

    assert result is not None
    expected = ImageNormalization(**grey, order="rgb").apply(IMAGES)  # type: ignore[arg-type]
    np.testing.assert_allclose(result.apply(IMAGES), expected, rtol=1e-5, atol=1e-5)


def test_what_is_padded_is_zero_below_and_to_the_right() -> None:
    table = {"size": [ROWS, COLUMNS]}

    result = images_of(table, (1, 6, 3, 20, 40), NORM).apply(IMAGES)

    assert result.shape == (1, 6, 3, 20, 40)
    assert not result[..., ROWS:, :].any()
    assert not result[..., COLUMNS:].any()
    np.testing.assert_array_equal(result[..., :ROWS, :COLUMNS], NORM.apply(IMAGES))


def test_tcps_strip_has_its_seams_where_the_published_one_has() -> None:
    """1400, 1200 and 1400 of 4000 columns are 315, 270 and 315 of 900."""
    assert CAMERA_NAMES == RIG_NAMES
    grey = np.array([40, 80, 120], np.uint8)  # front, front left, front right
    images = np.zeros((6, 288, 512, 3), np.uint8)
    images[:3] = grey[:, None, None, None]

    made = images_of({**TCP, "layout": "bhwc"}, (1, 256, 900, 3))
    result = made.apply(images)

    assert made.rendered == (288, 512)
    shades = result[0, 128, (0, 313, 316, 583, 586, 899), 0]
    assert shades.tolist() == [80, 80, 40, 40, 120, 120]


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"cameras": ["TOP"]}, "'FRONT', 'FRONT_LEFT'"),
        ({"cameras": []}, "at least 1 item"),
        ({"layout": "chv"}, "layout 'chv' must be the letters c, h and w"),
        ({"layout": "nhw"}, "layout 'nhw'"),
        ({"crop": [[0, 0, 5, 5]]}, "crop needs the camera_size"),
        ({**SMALL, "crop": [[0, 0, 17, 9]]}, "does not lie in 9 rows of 16 columns"),
        ({**SMALL, "crop": [[0, 0, 5, 5], [0, 0, 5, 5]]}, "2 crops for 6 cameras"),
        ({"mean": [1, 2, 3]}, "mean and std belong together"),
        ({"mean": [1, 2, 3], "std": [1, 0, 1]}, "std is zero"),
    ],
)
def test_a_wrong_table_is_refused(table: dict[str, Any], words: str) -> None:
    with pytest.raises(ValueError, match=words):
        ImageInput.model_validate(table)


@pytest.mark.parametrize(
    ("table", "shape", "words"),
    [
        ({}, (1, 5, 3, 8, 8), r"must be \[1, 6, 3, 'any', 'any'\]"),
        ({}, (1, 3, 8, 8), r"or \[images.img\] say which cameras it shows"),
        ({"cameras": ["FRONT"]}, (1, 8, 8, 3), r"must be \[1, 3, 'any', 'any'\]"),
        ({"layout": "chw"}, (3, 8, 8), r"has shape \[3, 8, 8\]"),
        ({"size": [9, 8]}, (1, 6, 3, 8, 8), "a size of 9 x 8 does not fit"),
        ({"stitch": True}, (1, 3, 8, 8), "camera_size must say"),
        (
            {**TCP, **TWO, "crop": [[0, 0, 100, 299], [0, 2, 100, 301]]},
            (1, 3, 256, 900),
            "rendered in 288 x 512, the crops that are stitched have 95 and 96 rows",
        ),
        (
            {**TCP, **TWO, "rendered": [9, 16], "crop": [[0, 0, 1, 900]]},
            (1, 3, 256, 900),
            "rendered in 9 x 16, a crop has no pixel",
        ),
    ],
)
def test_images_that_do_not_fit_the_input_are_refused(
    table: dict[str, Any], shape: tuple[int, ...], words: str
) -> None:
    with pytest.raises(EvaluationError, match=words):
        images_of(table, shape)


CARLA, LIDAR = Axes.FORWARD_RIGHT, Axes.RIGHT_FORWARD


@pytest.mark.parametrize(
    ("text", "axes", "expected"),
    [
        ("speed", CARLA, 6.0),
        ("velocity", LIDAR, [0.0, 6.0]),
        ("acceleration", CARLA, [1.0, -2.0]),
        ("acceleration{vertical=true}", LIDAR, [-2.0, 1.0, 9.0]),
        ("yaw-rate", LIDAR, 0.5),
        ("yaw-rate", CARLA, -0.5),
        ("target-point", CARLA, [20.0, -5.0]),
        ("target-point:far", LIDAR, [10.0, 60.0]),
        ("command", LIDAR, 3),
        ("command{numbers=[1, 0, 2, 2, 1, 0]}", LIDAR, 2),
        ("command{one_hot=6}", LIDAR, [0, 0, 0, 1, 0, 0]),
        ("timestamp", LIDAR, 1.0),
        ("timestamp:us", LIDAR, 1_000_000),
        ("use-previous", LIDAR, 1),
        ("l2g-translation", LIDAR, [10.0, 5.0, 0.0]),
        ("constant{values=[1, 2], shape=[2, 1]}", LIDAR, [[1], [2]]),
        # it drove north: what lies behind is at negative x, and was slower
        (
            "past{steps=4, spacing_s=0.25, quantities=[x, y, heading, speed]}",
            Axes.FORWARD_LEFT,
            [[-5, 0, 0, 4], [-4, 0, 0, 4], [-3, 0, 0, 4], [-1.5, 0, 0, 5]],
        ),
        # before the route the ego stood
        ("past{steps=3, spacing_s=1.0, newest_first=true}", LIDAR, [[0, -5]] * 3),
        # VAD's ``ego_his_trajs``: two steps of half a second, the last to now
        ("past{steps=2, deltas=true}", LIDAR, [[0, 2], [0, 3]]),
    ],
)
def test_a_source_says_it_in_the_models_axes(
    text: str, axes: Axes, expected: object
) -> None:
    np.testing.assert_allclose(value(text, axes), np.array(expected), atol=1e-6)


def test_the_can_bus_of_nuscenes_is_laid_out_otherwise() -> None:
    ours, theirs = value("can-bus"), value("can-bus:nuscenes")

    np.testing.assert_array_equal(theirs[[0, 1, 3, 16, 17]], ours[[0, 1, 3, 16, 17]])
    np.testing.assert_allclose(theirs[7:16], [1, 2, 9, 0, 0, 0.5, 6, 0, 0])
    bus = value("can-bus{absolute=true}")
    np.testing.assert_allclose(bus[[0, 1, 17]], [10.0, 5.0, 90.0], rtol=1e-6)


def test_the_lidar_pose_takes_points_to_the_world() -> None:
    """A point 2 m ahead (y of the lidar) of an ego that looks north."""
    rotation, place = value("l2g-rotation", LIDAR), value("l2g-translation", LIDAR)
    column = value("l2g-rotation{transposed=false}", LIDAR)

    np.testing.assert_allclose([0, 2, 1] @ rotation + place, [10, 7, 1], atol=1e-9)
    np.testing.assert_array_equal(column, rotation.T)


@pytest.mark.parametrize(
    ("axes", "point"),
    [
        (Axes.FORWARD_LEFT, (20.0, 5.0)),
        (Axes.RIGHT_FORWARD, (-5.0, 20.0)),
        (Axes.FORWARD_RIGHT, (20.0, -5.0)),
        (Axes.RIGHT_BACKWARD, (-5.0, -20.0)),
    ],
)
def test_the_front_camera_sees_a_point_on_the_ground(
    axes: Axes, point: tuple[float, float]
) -> None:
    """20 m ahead and 5 m to the left; the camera is 1.5 m ahead and 1.6 m up."""
    ground, seen = (*point, 0.0, 1.0), np.array([-5.0, 1.6, 18.5])
    focal = 80 / math.tan(math.radians(35))
    k = np.array([[focal, 0, 80], [0, focal, 0.42 * 90], [0, 0, 1]])

    lidar2cam, lidar2img = value("lidar2cam", axes)[0], value("lidar2img", axes)[0]

    np.testing.assert_allclose((lidar2cam @ ground)[:3], seen, atol=1e-4)
    np.testing.assert_allclose((lidar2img @ ground)[:3], k @ seen, rtol=1e-4)


@pytest.mark.parametrize("axes", list(Axes))
def test_intrinsics_are_those_of_the_rig_in_any_axes(axes: Axes) -> None:
    k = value("intrinsics{homogeneous=true}", axes)

    np.testing.assert_allclose(k[:, :3, :3], RIG.intrinsics, rtol=1e-4)
    np.testing.assert_array_equal(k[:, 3], [[0, 0, 0, 1]] * 6)
    np.testing.assert_allclose(value("lidar2cam")[:, :3, :3], RIG.rotations, atol=1e-5)


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("command{one_hot=4}", r"numbers \[0, 1, 2, 3, 4, 5\] do not fit one_hot = 4"),
        ("command{one_hot=1000000000}", "one_hot = 1000000000 classes, of 1000 at"),
        ("past{steps=1000000000}", "past: steps: Input should be less than"),
        ("past{steps=0}", "past: steps: Input should be greater than"),
        ("constant{values=[1], shape=[2]}", r"1 values have no shape \[2\]"),
        ("constant{values=[1, 2], shape=[-1, -2]}", r"shape\.0: Input should be"),
        ("constant{values=[1e300]}", r"values\.0: Input should be less than or equal"),
        ("velocities", "no input source 'velocities'; there are speed, velocity"),
        ("target-point:middle", "target-point: which: Input should be 'near' or 'far'"),
    ],
)
def test_a_wrong_source_is_one_line(text: str, words: str) -> None:
    with pytest.raises(EvaluationError, match=words):
        INPUT_SOURCES.parse(text)


@pytest.mark.parametrize(
    ("text", "missing", "words"),
    [
        ("target-point", "target_points", "asks for a target point"),
        ("l2g-rotation", "motion", "asks where the ego is"),
        ("past:2", "motion", "asks where the ego is"),
    ],
)
def test_what_an_observation_lacks_is_named(
    text: str, missing: str, words: str
) -> None:
    seen = observed()
    blank = dataclasses.replace(seen.observation, **{missing: None})  # type: ignore[arg-type]
    source = INPUT_SOURCES.parse(text)

    with pytest.raises(EvaluationError, match=words):
        source.value(dataclasses.replace(seen, observation=blank))


@pytest.mark.parametrize("name", INPUT_SOURCES.names())
def test_a_source_has_the_form_of_an_addition(name: str) -> None:
    needed: dict[str, dict[str, object]] = {
        "past": {"steps": 2},
        "constant": {"values": [1.5, 2.0]},
    }
    check_form(INPUT_SOURCES.build(name, needed.get(name, {})), INPUT_SOURCES)
