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

from me2e_compress.errors import EvaluationError
from me2e_compress.simulator.cameras import (
    CAMERA_NAMES,
    CameraRig,
    Cameras,
    GroundTexture,
    PixelClass,
    Weather,
)
from me2e_compress.simulator.scene import SignalState
from tests.simulator.cameras import town

STORM = Weather(fog_m=60.0, night=0.5, rain=0.7, brightness=1.1, noise=4.0, seed=3)
FRONT = CAMERA_NAMES.index("FRONT")
PROGRAM = """
import hashlib
from tests.simulator.cameras import town
from me2e_compress.simulator.cameras import CameraRig, Cameras, Weather
weather = Weather(fog_m=60.0, night=0.5, rain=0.7, brightness=1.1, noise=4.0, seed=3)
for options in (Weather(), weather):
    images = Cameras(town.paint(), CameraRig(96, 160), options).render(town.busy())
    print(hashlib.sha256(images.tobytes()).hexdigest())
"""


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
    cameras = Cameras(texture, rig, STORM)
    for time_us in (500_000, 50_000):
        cameras.render(replace(town.busy(), time_us=time_us))
    again = cameras.render(replace(town.busy(), time_us=0))
    np.testing.assert_array_equal(again, see(STORM))


@pytest.mark.parametrize(("seed", "time_us"), [(2, 0), (1, 10)])
def test_another_seed_or_time_gives_other_noise(
    see: Eyes, seed: int, time_us: int
) -> None:
    changed = see(Weather(noise=6.0, seed=seed), time_us)
    assert (changed != see(Weather(noise=6.0, seed=1))).mean() > 0.5


def test_frames_are_the_same_in_every_process() -> None:
    def hashes(salt: str) -> list[str]:
        done = subprocess.run(
            [sys.executable, "-c", PROGRAM],
            capture_output=True,
            text=True,
            check=True,
            env={**os.environ, "PYTHONHASHSEED": salt},
            cwd=Path(__file__).parents[3],
        )
        return done.stdout.split()

    first = hashes("1")
    assert first == hashes("2")
    assert len(set(first)) == 2
    images = Cameras(town.paint(), CameraRig(96, 160)).render(town.busy())
    assert hashlib.sha256(images.tobytes()).hexdigest() == first[0]


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
    labels = night.classes(scene)[FRONT]
    assert image[labels == PixelClass.TRAFFIC_LIGHT][:, 0].max() > 240
    assert image[labels == PixelClass.SKY].mean() < 40
    assert image[110, 112].mean() > 2 * image[110, 10].mean()


@pytest.mark.parametrize("gone", [("BACK",), ("FRONT", "BACK_LEFT")])
def test_a_dropped_camera_is_black_and_the_others_are_as_ever(
    see: Eyes, gone: tuple[str, ...]
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


def test_labels_know_no_weather(texture: GroundTexture, rig: CameraRig) -> None:
    stormy = Cameras(texture, rig, STORM).classes(town.busy())
    np.testing.assert_array_equal(stormy, Cameras(texture, rig).classes(town.busy()))


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"fog_m": 0.0}, "fog_m = 0.0 is out of range: 1 to"),
        ({"night": 1.5}, "night = 1.5 is out of range: 0 to 1"),
        ({"rain": -0.1}, "rain = -0.1 is out of range: 0 to 1"),
        ({"brightness": 9.0}, "brightness = 9.0 is out of range: 0 to 4"),
        ({"noise": float("nan")}, "noise = nan is out of range: 0 to 64"),
        ({"dropped": ("TOP",)}, "camera 'TOP'; there are FRONT, FRONT_LEFT"),
        ({"seed": -1}, "seed = -1 is out of range: 0 or more"),
    ],
)
def test_a_wrong_option_is_named(options: dict[str, float], words: str) -> None:
    with pytest.raises(EvaluationError, match=words):
        Weather(**options)  # type: ignore[arg-type]  # wrong on purpose
