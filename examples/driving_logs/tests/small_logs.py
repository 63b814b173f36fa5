"""Tiny data sets in the layouts of nuScenes and Bench2Drive, of one known drive.

A car drives a left bend; a white square is drawn in every picture where one point of
the world is seen. What is written is composed here from the poses, in each data set's
own frames (CARLA's are left-handed), not with the functions under test.
"""

import gzip
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt
from scipy.spatial.transform import Rotation

Floats = npt.NDArray[np.float64]

WIDTH, HEIGHT, FOCAL = 160, 90, 80.0
YAWS = {
    "CAM_FRONT": 0.0,
    "CAM_FRONT_LEFT": 55.0,
    "CAM_FRONT_RIGHT": -55.0,
    "CAM_BACK": 180.0,
    "CAM_BACK_LEFT": 110.0,
    "CAM_BACK_RIGHT": -110.0,
}
"""Degrees to the left."""
LIDAR_M = (0.94, 0.0, 1.84)
CAMERA_M = (1.2, 0.1, 1.5)
SPEED, BEND = 6.0, 0.03
START = (1000.0, 600.0, 0.7)
AHEAD = {camera: (12.0, math.radians(yaw + 8.0), 1.0) for camera, yaw in YAWS.items()}
"""Metres away, direction and height of what each camera sees, from the car."""


@dataclass(frozen=True)
class Car:
    """Where the reference point of the car is, right-handed."""

    x: float
    y: float
    heading: float

    @property
    def to_world(self) -> Floats:
        return moved(self.heading, (self.x, self.y, 0.0))


def car_at(seconds: float) -> Car:
    """A circle to the left."""
    turned = SPEED * BEND * seconds
    x, y, heading = START
    ahead, left = math.sin(turned) / BEND, (1 - math.cos(turned)) / BEND
    cos, sin = math.cos(heading), math.sin(heading)
    return Car(
        x + cos * ahead - sin * left, y + sin * ahead + cos * left, heading + turned
    )


def moved(heading: float, to: tuple[float, float, float]) -> Floats:
    out = np.eye(4)
    out[:3, :3] = Rotation.from_euler("z", heading).as_matrix()
    out[:3, 3] = to
    return out


def seen_point(camera: str) -> Floats:
    """The point that a camera sees, [4] in the frame of the car (x forward, y left)."""
    far, towards, up = AHEAD[camera]
    return np.array([far * math.cos(towards), far * math.sin(towards), up, 1.0])


def pixel(camera: str) -> tuple[float, float]:
    """Where that is in the picture: by hand, from a camera that looks level."""
    away = seen_point(camera)[:3] - CAMERA_M
    yaw = math.radians(YAWS[camera])
    depth = away[0] * math.cos(yaw) + away[1] * math.sin(yaw)
    right = away[0] * math.sin(yaw) - away[1] * math.cos(yaw)
    return WIDTH / 2 + FOCAL * right / depth, HEIGHT / 2 - FOCAL * away[2] / depth


def draw(path: Path, camera: str) -> None:
    picture = np.zeros((HEIGHT, WIDTH, 3), np.uint8)
    u, v = (round(each) for each in pixel(camera))
    picture[v - 2 : v + 3, u - 2 : u + 3] = 255
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(str(path), picture)


INTRINSIC = [[FOCAL, 0, WIDTH / 2], [0, FOCAL, HEIGHT / 2], [0, 0, 1]]


def write_nuscenes(root: Path, samples: int = 4, name: str = "scene-0001") -> Path:
    """A scene at 2 Hz."""
    tables: dict[str, list[dict[str, Any]]] = {
        "scene": [{"token": name, "name": name, "first_sample_token": f"{name}-0"}],
        "sensor": [{"token": s, "channel": s} for s in ("LIDAR_TOP", *YAWS)],
        "calibrated_sensor": [
            {
                "token": f"{sensor} on the car",
                "sensor_token": sensor,
                "translation": LIDAR_M if sensor == "LIDAR_TOP" else CAMERA_M,
                "rotation": _sensor_turn(sensor),
                "camera_intrinsic": [] if sensor == "LIDAR_TOP" else INTRINSIC,
            }
            for sensor in ("LIDAR_TOP", *YAWS)
        ],
        **{each: [] for each in ("sample", "sample_data", "ego_pose")},
    }
    messages = []
    for index in range(samples):
        _add_sample(root, tables, name, index, last=index == samples - 1)
        messages.append(
            {
                "utime": 1_500_000_000_000_000 + 500_000 * index - 1000,
                "accel": [0.1, 0.2, 9.8],
                "rotation_rate": [0.0, 0.0, SPEED * BEND],
                "vel": [SPEED, 0.0, 0.0],
            }
        )
    folder = root / "v1.0-mini"
    folder.mkdir(parents=True, exist_ok=True)
    for table, rows in tables.items():
        (folder / f"{table}.json").write_text(json.dumps(rows, indent=0))
    (root / "can_bus").mkdir(exist_ok=True)
    (root / "can_bus" / f"{name}_pose.json").write_text(json.dumps(messages))
    return root


def _add_sample(
    root: Path, tables: dict[str, Any], name: str, index: int, *, last: bool
) -> None:
    token, time_us = f"{name}-{index}", 1_500_000_000_000_000 + 500_000 * index
    after = "" if last else f"{name}-{index + 1}"
    tables["sample"].append(
        {"token": token, "scene_token": name, "timestamp": time_us, "next": after}
    )
    car = car_at(0.5 * index)
    for sensor in ("LIDAR_TOP", *YAWS):
        file = f"samples/{sensor}/{token}.png"
        tables["sample_data"].append(
            {
                "token": f"{token} {sensor}",
                "sample_token": token,
                "ego_pose_token": f"{token} {sensor}",
                "calibrated_sensor_token": f"{sensor} on the car",
                "is_key_frame": True,
                "filename": file,
            }
        )
        tables["ego_pose"].append(
            {
                "token": f"{token} {sensor}",
                "rotation": _wxyz(Rotation.from_euler("z", car.heading)),
                "translation": [car.x, car.y, 0.0],
            }
        )
        if sensor != "LIDAR_TOP":
            draw(root / file, sensor)


def _sensor_turn(sensor: str) -> list[float]:
    if sensor == "LIDAR_TOP":  # its x axis points to the right of the car
        return _wxyz(Rotation.from_euler("z", -90, degrees=True))
    looks = np.array([[0, 0, 1], [-1, 0, 0], [0, -1, 0]], float)  # level, straight on
    turn = Rotation.from_euler("z", YAWS[sensor], degrees=True).as_matrix()
    return _wxyz(Rotation.from_matrix(turn @ looks))


def _wxyz(turn: Rotation) -> list[float]:
    x, y, z, w = turn.as_quat().tolist()
    return [w, x, y, z]


CLIP = "ParkingCutIn_Town12_Route1_Weather3"


def write_bench2drive(root: Path, moments: int = 16) -> Path:
    """A clip at 10 Hz."""
    clip = root / CLIP
    (clip / "anno").mkdir(parents=True, exist_ok=True)
    for index in range(moments):
        with gzip.open(clip / "anno" / f"{index:05d}.json.gz", "wt") as file:
            json.dump(_annotation(index), file)
        for camera in YAWS:
            view = camera.lower().replace("cam_", "rgb_")
            draw(clip / "camera" / view / f"{index:05d}.jpg", camera)
    return root


def _annotation(index: int) -> dict[str, Any]:
    car = car_at(0.1 * index)
    mirrored = Car(car.x, -car.y, -car.heading)  # CARLA: x forward, y right
    ego_to_world = mirrored.to_world
    lidar_to_ego = moved(0.0, LIDAR_M)
    sensors: dict[str, Any] = {
        "LIDAR_TOP": {
            "world2lidar": np.linalg.inv(ego_to_world @ lidar_to_ego).tolist(),
            "lidar2ego": lidar_to_ego.tolist(),
        }
    }
    for camera, yaw in YAWS.items():
        forward, left, up = CAMERA_M
        cam2ego = moved(-math.radians(yaw), (forward, -left, up))
        sensors[camera] = {"intrinsic": INTRINSIC, "cam2ego": cam2ego.tolist()}
    return {
        "x": mirrored.x,
        "y": mirrored.y,
        "theta": math.nan,
        "speed": SPEED,
        "acceleration": [0.1, -0.2, 9.8],
        "angular_velocity": [0.0, 0.0, -SPEED * BEND],
        "command_near": 4,
        "sensors": sensors,
    }


MAKERS: dict[str, Callable[[Path], Path]] = {
    "nuscenes": write_nuscenes,
    "bench2drive": write_bench2drive,
}
