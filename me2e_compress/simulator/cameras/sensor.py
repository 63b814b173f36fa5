"""What happens inside the cameras: rain on the lens, noise, exposure, failure."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras.rig import CAMERA_NAMES, CameraRig
from me2e_compress.simulator.cameras.weather import Weather

Bytes = npt.NDArray[np.uint8]

RAIN_NOISE = 5.0
"""Grey levels of noise that heavy rain adds."""
STREAKS = 60
"""Streaks in an image in the heaviest rain."""
STREAK_LEVEL = 46
POOL = 2
"""The noise comes from a pool of this many sets of images, at a random offset."""


@dataclass(frozen=True, eq=False)
class Sensor:
    """Spoils finished images; the same weather, seed and time give the same bytes.

    Args:
        rig: The cameras.
        weather: The options.
    """

    rig: CameraRig
    weather: Weather

    def expose(self, images: Bytes, time_us: int) -> None:
        """Change uint8 [6, H, W, 3] in place."""
        weather = self.weather
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
