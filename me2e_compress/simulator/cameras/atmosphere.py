"""Light and fog between a surface and the camera."""

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.cameras.ground import SKY_M, GroundSampler
from me2e_compress.simulator.cameras.painter import Faces
from me2e_compress.simulator.cameras.weather import Weather

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]

KOSCHMIEDER = 3.0
"""Contrast after d metres of fog is exp(-3 d / visibility): 5 % at the visibility
(Koschmieder's law, CIE definition of meteorological optical range)."""
FOG = np.array([206.0, 210.0, 214.0])
MOONLIGHT = 0.12
"""What is left of the day's light at night = 1."""
BEAM_M, BEAM_RAD = 32.0, 0.45
"""Head lamps: light falls to 1/e at this distance and at this bearing (an own choice:
a dipped beam lights some 40 to 60 m of road)."""
DULL = 0.25
"""What heavy rain takes from the light."""


@dataclass(frozen=True, eq=False)
class Atmosphere:
    """Applies fog and darkness, to the still ground by pixel and to solids by place.

    Args:
        ground: Knows where in the ego frame each pixel of the ground lies.
        weather: The options.
    """

    ground: GroundSampler
    weather: Weather

    @property
    def clear(self) -> bool:
        """Whether there is nothing to do."""
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
        """uint8 [M, 3] colours of the faces as the cameras see them."""
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
        """Part of full light at places in the ego frame: daylight and head lamps."""
        beam = np.exp(-np.hypot(x, y) / BEAM_M)
        beam *= np.exp(-((np.arctan2(y, x) / BEAM_RAD) ** 2))
        return np.asarray(np.maximum(self._daylight, self.weather.night * beam))

    def _through(self, distance: Floats) -> Floats:
        """What fog (or heavy rain, at 300 m) lets through of a colour."""
        extinction = 0.0 if self.weather.fog_m is None else 1.0 / self.weather.fog_m
        extinction += self.weather.rain / 300.0
        return np.asarray(np.exp(-KOSCHMIEDER * extinction * distance))
