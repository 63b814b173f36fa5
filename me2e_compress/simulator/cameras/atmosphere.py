"""The effects of weather and sensor faults on the images."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import CAMERA_NAMES, CameraRig
from me2e_compress.simulator.cameras.ground import SKY_M, GroundSampler
from me2e_compress.simulator.cameras.painter import Faces
from me2e_compress.simulator.weather import CLEAR, Weather

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]


KOSCHMIEDER = 3.0
"""Contrast after d metres of fog is exp(-3 d / visibility): 5 % at the visibility
(Koschmieder's law, CIE definition of meteorological optical range)."""
FOG = np.array([206.0, 210.0, 214.0])
MOONLIGHT = 0.12
"""Share of the day's light that is left at night = 1."""
BEAM_M, BEAM_RAD = 32.0, 0.45
"""Head lamps: light falls to 1/e at this distance and at this bearing (our choice:
a dipped beam lights some 40 to 60 m of road)."""
DULL = 0.25
"""Share of the light that heavy rain takes."""


@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Applies fog and darkness, to the ground by pixel and to solids by position."""

    ground: GroundSampler
    weather: Weather

    @property
    def clear(self) -> bool:
        """Whether there is no fog, darkness or rain."""
        weather = self.weather
        return weather.fog_m is None and weather.night == 0.0 and weather.rain == 0.0

    def veil(self, images: Bytes) -> None:
        """Light and fog the sky and the ground of uint8 [6, H, W, 3], in place."""
        if self.clear:
            return
        gain, added = self._pixels
        flat = images.reshape(gain.shape)
        np.copyto(flat, cv2.add(cv2.multiply(flat, gain, dtype=cv2.CV_8U), added))

    def tint(self, faces: Faces) -> Bytes:
        """Return uint8 [M, 3], the colours of the faces as the cameras see them."""
        colours = faces.colours
        if not self.clear:
            light = self._light(faces.places[:, 0], faces.places[:, 1])
            light = np.where(faces.lamps, 1.0, light)
            through = self._through(faces.distances)[:, None]
            fog = FOG * self._daylight * (1.0 - through)
            colours = colours * light[:, None] * through + fog
        return np.rint(colours).astype(np.uint8)

    @cached_property
    def _pixels(self) -> tuple[npt.NDArray[np.float32], Bytes]:
        """Factor and summand for every pixel of the stacked images [6 * H, W, 3]."""
        distance = self.ground.distances_m
        x, y = np.moveaxis(self.ground.places, -1, 0)
        light = np.where(distance < SKY_M, self._light(x, y), self._daylight)
        through = self._through(distance)[..., None]
        gain = np.broadcast_to(light[..., None] * through, (*light.shape, 3))
        added = np.rint(FOG * self._daylight * (1.0 - through)).astype(np.uint8)
        stacked = (-1, *gain.shape[2:])
        return gain.astype(np.float32).reshape(stacked), added.reshape(stacked)

    @property
    def _daylight(self) -> float:
        day = 1.0 - self.weather.night * (1.0 - MOONLIGHT)
        return day * (1.0 - DULL * self.weather.rain)

    def _light(self, x: Floats, y: Floats) -> Floats:
        """Return the share of full light at places in the ego frame."""
        beam = np.exp(-np.hypot(x, y) / BEAM_M)
        beam *= np.exp(-((np.arctan2(y, x) / BEAM_RAD) ** 2))
        return np.asarray(np.maximum(self._daylight, self.weather.night * beam))

    def _through(self, distance: Floats) -> Floats:
        """Return the share of a colour that fog (or heavy rain, at 300 m) transmits."""
        extinction = 0.0 if self.weather.fog_m is None else 1.0 / self.weather.fog_m
        extinction += self.weather.rain / 300.0
        return np.asarray(np.exp(-KOSCHMIEDER * extinction * distance))


RAIN_NOISE = 5.0
"""Grey levels of noise that heavy rain adds."""
STREAKS = 60
"""Streaks in an image in the heaviest rain."""
STREAK_LEVEL = 46
POOL = 2
"""The noise comes from a pool of this many sets of images, at a random offset."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """Adds sensor faults; the same weather, seed and time give the same bytes."""

    rig: CameraRig
    weather: Weather

    def expose(self, images: Bytes, time_us: int) -> None:
        """Change uint8 [6, H, W, 3] in place."""
        weather = self.weather
        if weather == CLEAR:
            return
        rng = np.random.default_rng((weather.seed, time_us))
        if weather.rain > 0.0:
            self._rain(images, rng)
        flat = images.reshape(-1, self.rig.width, 3)
        if weather.brightness != 1.0:
            np.copyto(flat, cv2.convertScaleAbs(flat, alpha=weather.brightness))
        if self._deviation > 0.0:
            start = int(rng.integers(len(self._pool) - len(flat)))
            noise = self._pool[start : start + len(flat)]
            np.copyto(flat, cv2.add(flat, noise, dtype=cv2.CV_8U))
        for camera in weather.dropped:
            images[CAMERA_NAMES.index(camera)] = 0

    @property
    def _deviation(self) -> float:
        return float(np.hypot(self.weather.noise, RAIN_NOISE * self.weather.rain))

    @cached_property
    def _pool(self) -> npt.NDArray[np.int16]:
        """[POOL * 6 * H, W, 3] noise, drawn once."""
        rows = POOL * len(CAMERA_NAMES) * self.rig.height
        rng = np.random.default_rng(self.weather.seed)
        noise = rng.normal(0.0, self._deviation, (rows, self.rig.width, 3))
        return np.rint(noise).astype(np.int16)

    def _rain(self, images: Bytes, rng: np.random.Generator) -> None:
        """Brighten thin slanted streaks, new in every frame."""
        height, width = self.rig.height, self.rig.width
        count = round(STREAKS * self.weather.rain)
        for image in images:
            mask = np.zeros((height, width), np.uint8)
            x, y = rng.integers(0, width, count), rng.integers(0, height, count)
            length = rng.integers(height // 16, height // 6 + 1, count)
            ends = np.stack([x, y, x + length // 5, y + length], axis=1)
            lines = ends.reshape(-1, 2, 2).astype(np.int32)
            cv2.polylines(mask, list(lines), False, (STREAK_LEVEL,), 1, cv2.LINE_AA)
            np.copyto(image, cv2.add(image, cv2.merge([mask] * 3)))
