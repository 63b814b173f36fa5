"""Positions of the six cameras on the ego, and their projections.

Conventions: the ego frame is x forward, y left, z up, its origin on the ground under
the centre of the ego's box. A camera frame is x right, y down, z forward. Pixels are
continuous: the pixel of row r and column c covers [c, c + 1) x [r, r + 1), so its
centre is at (c + 0.5, r + 0.5).
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np
import numpy.typing as npt
from pydantic import ConfigDict, Field, with_config

from me2e_compress.base.errors import EvaluationError

Floats = npt.NDArray[np.float64]

SUBPIXEL_BITS = 4  # binary digits behind the point in what OpenCV is given to draw
CAMERA_HEIGHT_M = 1.6
# Row of the horizon as a part of the image height: nuScenes-like crops show more road
# than sky. The cameras look along the horizon (no pitch, no roll).
HORIZON = 0.42
SIDES_PX = (16, 4096)
CameraName = Literal[
    "FRONT", "FRONT_LEFT", "FRONT_RIGHT", "BACK", "BACK_LEFT", "BACK_RIGHT"
]
Share = Annotated[float, Field(ge=0.0, le=1.0)]
# Weather of routes: a third of them have some
DRAWN = ("clear",) * 8 + ("rain", "night", "fog", "dirt")


@dataclass(frozen=True, slots=True)
class Camera:
    """One pinhole camera, named as in nuScenes and Bench2Drive, without ``CAM_``.

    It looks ``yaw_deg`` counter-clockwise from straight ahead, with the horizontal
    field of view ``fov_deg``, from x metres forward and y to the left of the ego's
    centre.
    """

    name: CameraName
    yaw_deg: float
    fov_deg: float
    x_m: float
    y_m: float


# Order, yaws and fields of view of nuScenes' six cameras (Caesar et al., 2020)
CAMERAS = (
    Camera("FRONT", 0, 70, 1.5, 0.0),
    Camera("FRONT_LEFT", 55, 70, 1.3, 0.5),
    Camera("FRONT_RIGHT", -55, 70, 1.3, -0.5),
    Camera("BACK", 180, 110, -1.0, 0.0),
    Camera("BACK_LEFT", 110, 70, 0.8, 0.5),
    Camera("BACK_RIGHT", -110, 70, 0.8, -0.5),
)
CAMERA_NAMES = tuple(camera.name for camera in CAMERAS)


@dataclass(frozen=True, eq=False)
class CameraRig:
    """The six cameras at one image size, 16 to 4096 rows and columns."""

    height: int = 96
    width: int = 160

    def __post_init__(self) -> None:
        low, high = SIDES_PX
        for name, side in (("height", self.height), ("width", self.width)):
            if not low <= side <= high:
                words = f"camera {name} {side} px is out of range: {low} to {high} px"
                raise EvaluationError(words)

    @cached_property
    def focals_px(self) -> Floats:
        """[6] focal lengths in pixels, the same in both directions."""
        fov = np.deg2rad([camera.fov_deg for camera in CAMERAS])
        return np.asarray(self.width / 2 / np.tan(fov / 2))

    @property
    def centre_px(self) -> tuple[float, float]:
        """Principal point (column, row) of every camera."""
        return self.width / 2, self.height * HORIZON

    @cached_property
    def intrinsics(self) -> Floats:
        """[6, 3, 3] K: camera frame to pixels."""
        matrices = np.zeros((len(CAMERAS), 3, 3))
        matrices[:, 0, 0] = matrices[:, 1, 1] = self.focals_px
        matrices[:, 0, 2], matrices[:, 1, 2] = self.centre_px
        matrices[:, 2, 2] = 1.0
        return matrices

    @cached_property
    def rotations(self) -> Floats:
        """[6, 3, 3] R: ego frame to camera frame; rows are right, down, forward."""
        yaw = np.deg2rad([camera.yaw_deg for camera in CAMERAS])
        zero, one = np.zeros_like(yaw), np.ones_like(yaw)
        right = np.stack([np.sin(yaw), -np.cos(yaw), zero], axis=1)
        down = np.stack([zero, zero, -one], axis=1)
        forward = np.stack([np.cos(yaw), np.sin(yaw), zero], axis=1)
        return np.stack([right, down, forward], axis=1)

    @cached_property
    def positions(self) -> Floats:
        """[6, 3] optical centres in the ego frame, metres."""
        return np.array([(c.x_m, c.y_m, CAMERA_HEIGHT_M) for c in CAMERAS])

    @cached_property
    def lidar2img(self) -> npt.NDArray[np.float32]:
        """[6, 4, 4] ego frame to pixels, as nuScenes-style models expect it.

        For a point (x, y, z): M @ (x, y, z, 1) = (u * d, v * d, d, 1), with d the
        depth in metres and (u, v) the continuous pixel (column, row).
        """
        matrices = np.zeros((len(CAMERAS), 4, 4))
        # A point p of the ego frame is R (p - position) in the camera frame
        moved = -np.einsum("kij,kj->ki", self.rotations, self.positions)
        matrices[:, :3, :3] = self.intrinsics @ self.rotations
        matrices[:, :3, 3] = np.einsum("kij,kj->ki", self.intrinsics, moved)
        matrices[:, 3, 3] = 1.0
        return matrices.astype(np.float32)


def fixed_point(pixels: Floats) -> npt.NDArray[np.int32]:
    """Convert continuous pixels for cv2, which has pixel centres at whole numbers."""
    return np.rint((pixels - 0.5) * (1 << SUBPIXEL_BITS)).astype(np.int32)


# Weather and sensor faults that a route can be driven in.


@with_config(ConfigDict(extra="forbid"))
@dataclass(frozen=True, slots=True)
class Weather:
    """Weather and sensor faults, read from words. The default is a clear day.

    Args:
        fog_m: Meteorological visibility in metres (contrast 5 %); None for no fog.
        night: 0 for day to 1 for a night lit by the ego's head lamps alone.
        rain: 0 to 1: streaks, a grey sky and noise.
        brightness: Factor on all pixels, 0 to 4: exposure, or a dirty lens.
        noise: Standard deviation of the sensor's noise in grey levels, 0 to 64.
        dropped: Names of cameras that fail: their images are black.
        seed: Seed of rain and noise.
    """

    fog_m: Annotated[float, Field(ge=1.0, le=100_000.0)] | None = None
    night: Share = 0.0
    rain: Share = 0.0
    brightness: Annotated[float, Field(ge=0.0, le=4.0)] = 1.0
    noise: Annotated[float, Field(ge=0.0, le=64.0)] = 0.0
    dropped: tuple[CameraName, ...] = ()
    seed: Annotated[int, Field(ge=0)] = 0


CLEAR = Weather()


def drawn_weather(kind: str, strength: float, seed: int) -> Weather:
    """Return the weather of a kind in `DRAWN` at a strength from 0 to 1."""
    drawn = {
        "rain": Weather(rain=0.3 + 0.7 * strength, seed=seed),
        "night": Weather(night=0.5 + 0.5 * strength),
        "fog": Weather(fog_m=round(150.0 - 90.0 * strength, 1)),
        "dirt": Weather(brightness=1.0 - 0.4 * strength, noise=12.0 * strength),
    }
    return drawn.get(kind, CLEAR)
