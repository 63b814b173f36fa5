"""Sensors as Bench2Drive's VAD and UniAD agents mount them, and camera projections.

CARLA is left-handed: y to the right, yaw clockwise. Angles and positions are converted
once, here, to the ego frame of the contract: x forward, y left, its origin on the
ground under the centre of the ego.
"""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt
from pydantic import BaseModel, ConfigDict, Field

from me2e_compress.evaluators.carla.interface import SensorSpecs

Triple = tuple[float, float, float]

IMU, GPS, SPEED = "IMU", "GPS", "SPEED"
BEHIND_M = -1.4
"""Where those agents mount IMU and GPS: x of CARLA, on the ground."""


class CarlaCamera(BaseModel):
    """A level pinhole camera, in CARLA's own terms.

    Attributes:
        id: Its name in the leaderboard.
        x: Metres forward of the vehicle's centre.
        y: Metres to the right.
        z: Metres above the ground.
        yaw: Degrees, clockwise from straight ahead.
        fov: Horizontal field of view, degrees.
    """

    model_config = ConfigDict(frozen=True, extra="forbid", allow_inf_nan=False)

    id: str
    x: float
    y: float
    z: float = 1.6
    yaw: float
    fov: float = Field(default=70.0, gt=0.0, lt=180.0)


BENCH2DRIVE_CAMERAS = (
    CarlaCamera(id="CAM_FRONT", x=0.80, y=0.0, yaw=0.0),
    CarlaCamera(id="CAM_FRONT_LEFT", x=0.27, y=-0.55, yaw=-55.0),
    CarlaCamera(id="CAM_FRONT_RIGHT", x=0.27, y=0.55, yaw=55.0),
    CarlaCamera(id="CAM_BACK", x=-2.0, y=0.0, yaw=180.0, fov=110.0),
    CarlaCamera(id="CAM_BACK_LEFT", x=-0.32, y=-0.55, yaw=-110.0),
    CarlaCamera(id="CAM_BACK_RIGHT", x=-0.32, y=0.55, yaw=110.0),
)
"""Bench2DriveZoo, team_code/vad_b2d_agent.py and uniad_b2d_agent.py, ``sensors``; in
the contract's order."""


@dataclass(frozen=True, eq=False)
class CarlaRig:
    """Six cameras, their pictures as rendered by CARLA and as taken by a model.

    A whole picture is scaled to the largest size that fits and placed at the upper
    left: 1600 x 900 at 0.4 in 384 rows of 640 leaves 24 rows below, as the pipelines of
    VAD and UniAD pad. ``rendered`` is columns and rows of CARLA's pictures, ``taken``
    rows and columns of the model's.
    """

    cameras: tuple[CarlaCamera, ...]
    rendered: tuple[int, int]
    taken: tuple[int, int]

    @property
    def scale(self) -> float:
        """Factor from CARLA's to the model's pixels."""
        (columns, rows), (high, wide) = self.rendered, self.taken
        return min(wide / columns, high / rows)

    def specs(self, seen: Collection[int]) -> SensorSpecs:
        """List the sensors that an agent asks for: cameras, IMU, GPS, speedometer.

        ``seen`` holds the indices of the cameras that a model sees.
        """
        columns, rows = self.rendered
        # cameras that the model sees
        mounted: SensorSpecs = [
            {
                "type": "sensor.camera.rgb",
                **{"x": camera.x, "y": camera.y, "z": camera.z},
                **{"roll": 0.0, "pitch": 0.0, "yaw": camera.yaw},
                **{"width": columns, "height": rows, "fov": camera.fov},
                "id": camera.id,
            }
            for place, camera in enumerate(self.cameras)
            if place in seen
        ]
        # IMU, GPS and speedometer
        level = {"roll": 0.0, "pitch": 0.0, "yaw": 0.0}
        behind = {"x": BEHIND_M, "y": 0.0, "z": 0.0, **level}
        others: SensorSpecs = [
            {"type": "sensor.other.imu", **behind, "id": IMU},
            {"type": "sensor.other.gnss", **behind, "id": GPS},
            {"type": "sensor.speedometer", "reading_frequency": 20, "id": SPEED},
        ]
        return [*mounted, *others]

    def lidar2img(self, origin_m: Triple) -> npt.NDArray[np.float32]:
        """Return [6, 4, 4], from a frame parallel to the ego's to the model's pixels.

        ``origin_m`` is that frame's origin in the ego frame.
        """
        places = [self._projection(camera) for camera in self.cameras]
        moved = np.eye(4)
        moved[:3, 3] = origin_m
        return np.asarray(np.stack(places) @ moved, np.float32)

    def _projection(self, camera: CarlaCamera) -> npt.NDArray[np.float64]:
        columns, rows = self.rendered
        focal = columns / 2 / np.tan(np.deg2rad(camera.fov) / 2)
        intrinsics = self.scale * np.array(
            [[focal, 0, columns / 2], [0, focal, rows / 2], [0, 0, 1 / self.scale]]
        )
        yaw = -np.deg2rad(camera.yaw)
        sin, cos = np.sin(yaw), np.cos(yaw)
        # rows: the camera's right, down and forward in the ego frame
        turn = np.array([[sin, -cos, 0.0], [0.0, 0.0, -1.0], [cos, sin, 0.0]])
        matrix = np.eye(4)
        matrix[:3, :3] = intrinsics @ turn
        matrix[:3, 3] = -intrinsics @ turn @ (camera.x, -camera.y, camera.z)
        return matrix
