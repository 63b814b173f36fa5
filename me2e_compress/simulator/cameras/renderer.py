"""The six cameras of one route: sky, ground and solids, then weather and sensor."""

from dataclasses import dataclass
from functools import cache, cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import (
    CAMERA_NAMES,
    CAMERAS,
    CLEAR,
    CameraRig,
    Weather,
)
from me2e_compress.simulator.cameras.ground import (
    SKY_M,
    Bytes,
    GroundSampler,
    GroundTexture,
)
from me2e_compress.simulator.cameras.painter import Faces, Painter, draw
from me2e_compress.simulator.cameras.solids import solids_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Scene

# Contrast after d metres of fog is exp(-3 d / visibility): 5 % at the visibility
# (Koschmieder's law, CIE definition of meteorological optical range)
KOSCHMIEDER = 3.0
FOG = np.array([206.0, 210.0, 214.0])
MOONLIGHT = 0.12  # share of the day's light that is left at night = 1
# Head lamps: light falls to 1/e at this distance and at this bearing (our choice: a
# dipped beam lights some 40 to 60 m of road)
BEAM_M, BEAM_RAD = 32.0, 0.45
DULL = 0.25  # share of the light that heavy rain takes
RAIN_NOISE = 5.0  # grey levels of noise that heavy rain adds
STREAKS = 60  # streaks in an image in the heaviest rain
STREAK_LEVEL = 46
POOL = 2  # the noise comes from a pool of this many sets of images, at a random offset
ZENITH, HAZE = (128, 170, 224), (216, 228, 238)
HILLS, TREES = (122, 146, 142), (66, 94, 60)
COLUMNS, ROWS = 2880, 64  # panorama: 0.125 degrees a column
TALLEST = 0.1  # tangent of the panorama's upper edge; above it the sky is even


# The effects of weather and sensor faults on the images.


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
        x, y = np.moveaxis(self.ground.places, -1, 0)
        camera_x, camera_y = self.ground.rig.positions[:, :2, None, None].swapaxes(0, 1)
        distance = np.hypot(x - camera_x, y - camera_y)
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
            # thin slanted streaks, new in every frame
            height, width = self.rig.height, self.rig.width
            count = round(STREAKS * weather.rain)
            for image in images:
                mask = np.zeros((height, width), np.uint8)
                x, y = rng.integers(0, width, count), rng.integers(0, height, count)
                length = rng.integers(height // 16, height // 6 + 1, count)
                ends = np.stack([x, y, x + length // 5, y + length], axis=1)
                lines = list(ends.reshape(-1, 2, 2).astype(np.int32))
                cv2.polylines(mask, lines, False, (STREAK_LEVEL,), 1, cv2.LINE_AA)
                np.copyto(image, cv2.add(image, cv2.merge([mask] * 3)))
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


@dataclass(frozen=True, eq=False)
class Sky:
    """Fills the rows above the horizon with one seeded skyline for all cameras."""

    rig: CameraRig

    @property
    def height(self) -> int:
        """The number of sky rows: those with their centre above the horizon."""
        return int(np.floor(self.rig.centre_px[1] + 0.5))

    def paint(self, images: Bytes, heading: float) -> None:
        """Fill the sky rows of uint8 [6, H, W, 3] for an ego heading in radians."""
        first, texels, zenith = self._strip
        images[:, :first] = zenith
        turned = round(heading / (2 * np.pi) * COLUMNS) % COLUMNS
        pixels = _panorama()[turned:].take(texels).view(np.uint8)
        strip = cv2.cvtColor(pixels.reshape(-1, self.rig.width, 4), cv2.COLOR_RGBA2RGB)
        images[:, first : self.height] = strip.reshape(*texels.shape, 3)

    @cached_property
    def _strip(self) -> tuple[int, npt.NDArray[np.intp], Bytes]:
        """First row, its texels [6, R, W] at heading 0, and the rows above it."""
        focal = self.rig.focals_px[:, None]
        centre_column, horizon = self.rig.centre_px
        tangent = (np.arange(self.rig.width) + 0.5 - centre_column) / focal
        slant = np.hypot(1.0, tangent)
        first = max(0, int(horizon - TALLEST * (focal * slant).max()))
        rise = (horizon - np.arange(first, self.height) - 0.5) / focal
        elevation = rise[:, :, None] / slant[:, None, :]
        row = np.clip((1.0 - elevation / TALLEST) * ROWS, 0, ROWS - 1).astype(np.intp)
        yaw = np.deg2rad([camera.yaw_deg for camera in CAMERAS])[:, None]
        azimuth = (yaw - np.arctan(tangent)) / (2 * np.pi) % 1.0
        column = (azimuth * COLUMNS).astype(np.intp)
        zenith = np.tile(np.array(ZENITH, np.uint8), (first, self.rig.width, 1))
        return first, row * (2 * COLUMNS) + column[:, None, :], zenith


@cache
def _panorama() -> npt.NDArray[np.uint32]:
    """[ROWS * 2 * COLUMNS] RGBA texels, twice around: no index needs to wrap."""
    rng = np.random.default_rng(0)
    # a gradient from haze to zenith
    elevation = TALLEST * (1.0 - (np.arange(ROWS) + 0.5) / ROWS)[:, None]
    share = np.sqrt(elevation / TALLEST)[..., None]
    sky = (1 - share) * np.array(HAZE, float) + share * np.array(ZENITH, float)
    picture = np.repeat(sky, COLUMNS, axis=1)
    # hills, then trees, antialiased along their skylines
    layers = (
        (HILLS, 0.045, 0.035, (2, 3, 5, 9)),
        (TREES, 0.014, 0.012, (7, 23, 61, 137)),
    )
    angle = np.arange(COLUMNS) / COLUMNS * 2 * np.pi
    for colour, mean, spread, waves in layers:
        # waves around the circle with seeded phases, [COLUMNS] in -1 .. 1
        phases = rng.uniform(0, 2 * np.pi, len(waves))
        terms = [np.sin(n * angle + p) for n, p in zip(waves, phases, strict=True)]
        skyline = mean + spread * np.mean(terms, axis=0)
        covered = (skyline - elevation) * ROWS / TALLEST + 0.5
        alpha = np.clip(covered, 0.0, 1.0)[..., None]
        picture = (1 - alpha) * picture + alpha * np.array(colour, float)
    rounded = np.rint(np.concatenate([picture, picture], axis=1)).astype(np.uint8)
    texels = np.asarray(cv2.cvtColor(rounded, cv2.COLOR_RGB2RGBA), np.uint8)
    return texels.reshape(-1).view(np.uint32)


class Cameras:
    """Renders scenes; the pixels depend on the scene (and its time) alone."""

    def __init__(
        self,
        texture: GroundTexture,
        rig: CameraRig | None = None,
        weather: Weather = CLEAR,
    ) -> None:
        cv2.setNumThreads(1)  # routes run in parallel, one process each
        self.texture, self.rig = texture, rig or CameraRig()
        self._shape = len(CAMERAS), self.rig.height, self.rig.width
        self._sky, self._painter = Sky(self.rig), Painter(self.rig)
        self._ground = GroundSampler(self.rig)
        self._atmosphere = Atmosphere(self._ground, weather)
        self._sensor = Sensor(self.rig, weather)

    def render(self, scene: Scene) -> Bytes:
        """Render the six images, uint8 [6, H, W, 3], RGB, in the order of the rig."""
        images = np.empty((*self._shape, 3), np.uint8)
        # background: sky and ground, with light and fog pixel by pixel
        self._sky.paint(images, scene.ego.heading)
        self._ground.paint(images, self.texture, scene.ego)
        self._atmosphere.veil(images)
        # solids from far to near, with light and fog face by face
        if solids := solids_of(scene):
            faces = self._painter.faces(solids, scene.ego)
            draw(images, faces, self._atmosphere.tint(faces))
        # rain on the lens, exposure, noise and failed cameras
        self._sensor.expose(images, scene.time_us)
        return images
