import dataclasses
import math

import numpy as np
import pytest

from me2e_compress.driving.input_sources import INPUT_SOURCES, Axes
from me2e_compress.errors import EvaluationError
from me2e_compress.testing import check_form
from tests.driving.observed import RIG, observed, value

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
    ],
)
def test_a_source_says_it_in_the_models_axes(
    text: str, axes: Axes, expected: object
) -> None:
    np.testing.assert_allclose(value(text, axes), np.array(expected), atol=1e-6)


@pytest.mark.parametrize(
    ("text", "axes", "expected"),
    [
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
def test_the_past_is_seen_from_now_and_interpolated(
    text: str, axes: Axes, expected: object
) -> None:
    np.testing.assert_allclose(value(text, axes), np.array(expected), atol=1e-9)


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
        ("past{steps=0}", "past: 0 steps 0.5 s apart"),
        ("constant{values=[1], shape=[2]}", r"1 values have no shape \[2\]"),
        ("constant{values=[1, 2], shape=[-1, -2]}", r"no shape \[-1, -2\]"),
        ("constant{values=[1e300]}", "values must be finite, up to 1e.18"),
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
