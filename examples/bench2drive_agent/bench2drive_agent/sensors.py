"""Sensors as Bench2Drive's VAD and UniAD agents mount them, and what they see."""

from collections.abc import Collection
from dataclasses import dataclass
from typing import Any, TypeAlias

import cv2
import numpy as np
import numpy.typing as npt

Images: TypeAlias = npt.NDArray[np.uint8]
Triple: TypeAlias = tuple[float, float, float]

COLUMNS, ROWS = 1600, 900
CAMERAS = {
    "CAM_FRONT": (0.80, 0.0, 0.0, 70.0),
    "CAM_FRONT_LEFT": (0.27, -0.55, -55.0, 70.0),
    "CAM_FRONT_RIGHT": (0.27, 0.55, 55.0, 70.0),
    "CAM_BACK": (-2.0, 0.0, 180.0, 110.0),
    "CAM_BACK_LEFT": (-0.32, -0.55, -110.0, 70.0),
    "CAM_BACK_RIGHT": (-0.32, 0.55, 110.0, 70.0),
}
"""x, y (to the right), yaw (clockwise) and field of view in the contract's order:
Bench2DriveZoo, team_code/vad_b2d_agent.py and uniad_b2d_agent.py."""
CAMERA_M, BEHIND_M = 1.6, -1.4
"""Height of the cameras, and x of IMU and GPS, there."""
IMU, GPS, SPEED = "IMU", "GPS", "SPEED"


def specs(seen: Collection[int]) -> list[dict[str, Any]]:
    """List the sensors to mount: the cameras that are seen, IMU, GPS, speedometer."""
    level = {"roll": 0.0, "pitch": 0.0}
    mounted: list[dict[str, Any]] = [
        {
            "type": "sensor.camera.rgb",
            **{"x": x, "y": y, "z": CAMERA_M, **level, "yaw": yaw},
            **{"width": COLUMNS, "height": ROWS, "fov": fov, "id": name},
        }
        for index, (name, (x, y, yaw, fov)) in enumerate(CAMERAS.items())
        if index in seen
    ]
    behind = {"x": BEHIND_M, "y": 0.0, "z": 0.0, **level, "yaw": 0.0}
    return [
        *mounted,
        {"type": "sensor.other.imu", **behind, "id": IMU},
        {"type": "sensor.other.gnss", **behind, "id": GPS},
        {"type": "sensor.speedometer", "reading_frequency": 20, "id": SPEED},
    ]


@dataclass(frozen=True)
class Pictures:
    """How CARLA's pictures become the model's images.

    A whole picture is scaled to the largest size that fits and placed at the upper
    left, as the pipelines of VAD and UniAD pad.

    Attributes:
        size: rows and columns of the model's images.
        jpeg_quality: every picture is written and read as a JPEG, as Bench2Drive's
            agents do to match their training data; 0 leaves it as it is.
        fill: the padding's colour, R, G, B.
    """

    size: tuple[int, int]
    jpeg_quality: int
    fill: tuple[int, ...]

    @property
    def scale(self) -> float:
        """Factor from CARLA's to the model's pixels."""
        rows, columns = self.size
        return min(columns / COLUMNS, rows / ROWS)

    def image(self, bgra: Images) -> Images:
        """Convert a picture, BGRA [rows, columns, 4], to RGB of the model's size."""
        picture = np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGB))
        if self.jpeg_quality:
            # red and blue swapped, as in those agents: chroma is what it costs
            quality = (cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality)
            _, content = cv2.imencode(".jpg", picture, quality)
            picture = np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))
        columns, rows = round(COLUMNS * self.scale), round(ROWS * self.scale)
        image = np.full((*self.size, 3), self.fill, np.uint8)
        image[:rows, :columns] = cv2.resize(picture, (columns, rows))
        return image

    def lidar2img(self, origin_m: Triple) -> npt.NDArray[np.float32]:
        """Return [6, 4, 4] to the model's pixels from the ego frame, moved to origin_m.

        The ego frame is that of the contract: x forward, y left.
        """
        moved = np.eye(4)
        moved[:3, 3] = origin_m
        cameras = [self._projection(*camera) for camera in CAMERAS.values()]
        return np.asarray(np.stack(cameras) @ moved, np.float32)

    def _projection(
        self, x: float, y: float, yaw_deg: float, fov_deg: float
    ) -> npt.NDArray[np.float64]:
        focal = COLUMNS / 2 / np.tan(np.deg2rad(fov_deg) / 2)
        intrinsics = self.scale * np.array(
            [[focal, 0, COLUMNS / 2], [0, focal, ROWS / 2], [0, 0, 1 / self.scale]]
        )
        yaw = -np.deg2rad(yaw_deg)
        sin, cos = np.sin(yaw), np.cos(yaw)
        # rows: the camera's right, down and forward in the ego frame
        turn = np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])
        matrix = np.eye(4)
        matrix[:3, :3] = intrinsics @ turn
        matrix[:3, 3] = -intrinsics @ turn @ (x, -y, CAMERA_M)
        return matrix
