import hashlib
import os
import subprocess
import sys
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import numpy.typing as npt
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress.simulator.camera_rig import (
    CAMERA_NAMES,
    CameraName,
    CameraRig,
    Weather,
)
from me2e_compress.simulator.cameras.ground import GroundTexture, paint_texture
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.plane_geometry import Roadmap
from me2e_compress.simulator.scene import Ego, SignalState
from tests.simulator.cameras import town
from tests.support.profiles import scaled

FRONT = CAMERA_NAMES.index("FRONT")


def project(
    rig: CameraRig, camera: int, ego: Ego, x: float, y: float
) -> tuple[float, float, float]:
    """Pixel and depth of a world point on the ground."""
    cos, sin = np.cos(ego.heading), np.sin(ego.heading)
    dx, dy = x - ego.x, y - ego.y
    point = (cos * dx + sin * dy, cos * dy - sin * dx, 0.0, 1.0)
    u, v, depth, _ = rig.lidar2img[camera].astype(float) @ point
    return float(u / depth), float(v / depth), float(depth)


def bar(x: float, y: float) -> tuple[Roadmap, npt.NDArray[np.float64]]:
    """Bare grass with a white bar of 1 m x 0.5 m around a point; its corners."""
    ends = ((x - 0.5, y), (x + 0.5, y))
    corners = np.array([(-0.5, -0.25), (0.5, -0.25), (0.5, 0.25), (-0.5, 0.25)])
    return Roadmap((), (ends,)), corners + np.array([x, y])


def centroid(polygon: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Of the area of a polygon [N, 2]."""
    a, b = polygon, np.roll(polygon, -1, axis=0)
    cross = a[:, 0] * b[:, 1] - b[:, 0] * a[:, 1]
    return np.asarray(((a + b) * cross[:, None]).sum(axis=0) / (3 * cross.sum()))


@settings(max_examples=scaled(25))
@given(
    distance=st.floats(6.0, 22.0),
    azimuth=st.floats(-np.pi, np.pi),
    heading=st.floats(-np.pi, np.pi),
)
def test_a_bar_on_the_road_is_drawn_where_lidar2img_says(
    distance: float, azimuth: float, heading: float
) -> None:
    rig = CameraRig(128, 224)
    x, y = distance * np.cos(azimuth), distance * np.sin(azimuth)
    ego = town.ego(0.0, 0.0, heading)
    roadmap, corners = bar(x, y)
    route, scene = np.array([(0.0, 0.0), (1.0, 0.0)]), town.scene(seen_from=ego)
    painted, bare = (
        Cameras(paint_texture(roads, route), rig).render(scene).astype(float)
        for roads in (roadmap, Roadmap(()))
    )
    added = (painted - bare).sum(axis=3)
    views, wide = 0, False
    for camera in range(6):
        pixels = np.array([project(rig, camera, ego, *corner) for corner in corners])
        wide = wide or is_wide(pixels)
        if not is_sharp(pixels):
            continue
        white = added[camera]
        rows, columns = np.mgrid[0:128, 0:224] + 0.5
        middle = np.array([(columns * white).sum(), (rows * white).sum()]) / white.sum()
        # One pixel; close by, where a texel of 0.125 m covers many, a quarter of it, as
        # it is seen: turned against the camera it is wider than its side.
        square = np.array([(x, y)]) + (corners - (x, y)) * (0.125, 0.25)
        texel = np.array([project(rig, camera, ego, *corner) for corner in square])
        allowed = max(1.0, np.ptp(texel[:, :2], axis=0).max() / 4)
        np.testing.assert_allclose(middle, centroid(pixels[:, :2]), atol=allowed)
        views += 1
    assert views >= 1 or not wide


def is_sharp(pixels: npt.NDArray[np.float64]) -> bool:
    """Whether a bar's centroid says anything: whole in the image, two rows at least.

    Thinner than that, a slanted bar is sampled in steps.
    """
    inside = (pixels[:, :2] > 4).all() and (pixels[:, :2] < (220, 124)).all()
    return bool(inside and pixels[:, 2].min() >= 2.0 and np.ptp(pixels[:, 1]) >= 2.0)


def is_wide(pixels: npt.NDArray[np.float64]) -> bool:
    """Whether the whole bar is well inside an image, and three rows high."""
    whole = (np.abs(pixels[:, 0] - 112) < 100).all() and (pixels[:, 1] < 120).all()
    return bool(whole and pixels[:, 2].min() > 2.0 and np.ptp(pixels[:, 1]) >= 3.0)


@pytest.mark.parametrize("size", [(33, 47), (96, 160), (241, 321)])
def test_any_size_is_rendered(texture: GroundTexture, size: tuple[int, int]) -> None:
    images = Cameras(texture, CameraRig(*size)).render(town.busy())
    assert images.shape == (6, *size, 3)
    assert images.dtype == np.uint8


def test_the_texture_is_read_only_and_its_levels_nest(texture: GroundTexture) -> None:
    sizes = [level.shape[:2] for level in texture.levels]
    assert all(
        (2 * a, 2 * b) == c for (a, b), c in zip(sizes[1:], sizes[:-1], strict=True)
    )
    with pytest.raises(ValueError, match="read-only"):
        texture.classes[0, 0] = 0


Eyes = Callable[..., npt.NDArray[np.int64]]


@pytest.fixture
def see(texture: GroundTexture, rig: CameraRig) -> Eyes:
    def seen(weather: Weather, time_us: int = 0) -> npt.NDArray[np.int64]:
        scene = replace(town.busy(), time_us=time_us)
        return Cameras(texture, rig, weather).render(scene).astype(np.int64)

    return seen


def test_an_image_does_not_depend_on_those_before(
    texture: GroundTexture, rig: CameraRig, see: Eyes
) -> None:
    cameras = Cameras(texture, rig, town.STORM)
    for time_us in (500_000, 50_000):
        cameras.render(replace(town.busy(), time_us=time_us))
    again = cameras.render(replace(town.busy(), time_us=0))
    np.testing.assert_array_equal(again, see(town.STORM))


@pytest.mark.parametrize(("seed", "time_us"), [(2, 0), (1, 10)])
def test_another_seed_or_time_gives_other_noise(
    see: Eyes, seed: int, time_us: int
) -> None:
    changed = see(Weather(noise=6.0, seed=seed), time_us)
    assert (changed != see(Weather(noise=6.0, seed=1))).mean() > 0.5


def test_fog_halves_contrast_at_the_distance_koschmieder_gives(
    texture: GroundTexture, rig: CameraRig
) -> None:
    # exp(-3 d / V) = 1/2 at d = V ln 2 / 3
    row = 100
    depth = 1.6 * rig.focals_px[FRONT] / (row + 0.5 - 0.42 * 128)
    weather = Weather(fog_m=3 * depth / np.log(2))
    empty = town.scene()
    clear = Cameras(texture, rig).render(empty)[FRONT, row, 112].astype(float)
    foggy = Cameras(texture, rig, weather).render(empty)[FRONT, row, 112]
    np.testing.assert_allclose(foggy, (clear + np.array([206, 210, 214])) / 2, atol=2.0)


def test_at_night_lamps_shine_and_the_rest_is_dark(
    texture: GroundTexture, rig: CameraRig
) -> None:
    scene = town.light(SignalState.RED)
    night = Cameras(texture, rig, Weather(night=1.0))
    image = night.render(scene)[FRONT].astype(int)
    assert image[town.covered(rig, scene)[FRONT]][:, 0].max() > 240
    assert image[:54].mean() < 40
    assert image[110, 112].mean() > 2 * image[110, 10].mean()


@pytest.mark.parametrize("gone", [("BACK",), ("FRONT", "BACK_LEFT")])
def test_a_dropped_camera_is_black_and_the_others_are_as_ever(
    see: Eyes, gone: tuple[CameraName, ...]
) -> None:
    whole, images = see(Weather()), see(Weather(dropped=gone))
    for i, name in enumerate(CAMERA_NAMES):
        expected = np.zeros_like(whole[i]) if name in gone else whole[i]
        np.testing.assert_array_equal(images[i], expected)


def test_brightness_saturates_and_noise_has_the_deviation_asked_for(see: Eyes) -> None:
    clear = see(Weather())
    expected = np.minimum(np.rint(clear * 1.5), 255)
    np.testing.assert_allclose(see(Weather(brightness=1.5)), expected, atol=1)
    noise = (see(Weather(noise=8.0)) - clear)[(clear > 40) & (clear < 215)]
    assert noise.std() == pytest.approx(8.0, rel=0.05)
    assert abs(noise.mean()) < 0.2


PROGRAM = """
import hashlib
from tests.simulator.cameras import town
from me2e_compress.simulator.camera_rig import CameraRig, Weather
from me2e_compress.simulator.cameras.renderer import Cameras
for options in (Weather(), town.STORM):
    images = Cameras(town.paint(), CameraRig(96, 160), options).render(town.busy())
    print(hashlib.sha256(images.tobytes()).hexdigest())
"""


def test_frames_are_the_same_in_every_process() -> None:
    def hashes(salt: str) -> list[str]:
        command, place = [sys.executable, "-c", PROGRAM], Path(__file__).parents[3]
        salted = {**os.environ, "PYTHONHASHSEED": salt}
        return subprocess.check_output(
            command, env=salted, cwd=place, text=True
        ).split()

    first = hashes("1")
    assert first == hashes("2")
    assert len(set(first)) == 2
    images = Cameras(town.paint(), CameraRig(96, 160)).render(town.busy())
    assert hashlib.sha256(images.tobytes()).hexdigest() == first[0]
