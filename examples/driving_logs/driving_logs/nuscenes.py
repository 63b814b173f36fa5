"""nuScenes (Caesar et al. 2020): key frames at 2 Hz, six cameras, CAN bus."""

import functools
import math
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Literal, Self

import numpy as np

from driving_logs.framed_log import FramedLog
from driving_logs.moments import (
    CAMERAS,
    CAN_BUS_SIZE,
    Floats,
    LogMoment,
    intrinsics,
    matrix_of,
)
from driving_logs.nuscenes_tables import NuScenesTables, Row, rows
from me2e_compress.base.errors import FramesError

LIDAR = "LIDAR_TOP"
CENTRE_M = 0.5
"""Distance of the vehicle's centre ahead of its lidar: UniAD's and VAD's metric."""
TURN_M = 2.0
"""Sideways distance in 3 s from which the command is a turn: UniAD and VAD."""
CONVERTED = (
    "CAM_FRONT",
    "CAM_FRONT_RIGHT",
    "CAM_FRONT_LEFT",
    "CAM_BACK",
    "CAM_BACK_LEFT",
    "CAM_BACK_RIGHT",
)
"""Cameras in the order of mmdetection3d's converter, used by UniAD and VAD for
nuScenes."""
CAN_BUS_KEYS = ("accel", "rotation_rate", "vel")
"""Keys of a pose message in the order of the published ``can_bus``, from index 7."""


@dataclass(frozen=True)
class NuScenesLog(FramedLog):
    """nuScenes: tables of a version, pictures under samples/, CAN bus if present.

    The CAN bus expansion is searched in ``can_bus/`` in the folder and beside it;
    without data of a scene, its numbers are zeros, as in UniAD and VAD.

    Attributes:
        root: the folder that holds ``v1.0-*`` and ``samples``.
        version: version of the tables; empty means the only one present.
        layout: order of commands, CAN bus and cameras: ``nuscenes`` as UniAD and VAD
            for nuScenes (right, left, straight; front right before front left),
            ``bench2drive`` as Bench2Drive and the policy contract (left, right,
            straight, follow; front left before front right).
        scenes: by name, such as scene-0061; empty means all.
        cameras: in the order of the image input; empty means all, as in `layout`.
        every: takes every n-th key frame.
    """

    name: ClassVar[str] = "nuscenes"
    half_second: ClassVar[int] = 1

    root: Path = field(kw_only=False)
    version: str = ""
    layout: Literal["nuscenes", "bench2drive"] = "nuscenes"

    def as_contract(self) -> Self:
        """Return it in Bench2Drive's layout, which is that of the policy contract."""
        return replace(self, layout="bench2drive")

    @property
    def all_cameras(self) -> tuple[str, ...]:
        """All cameras, in the order of the layout."""
        return CONVERTED if self.layout == "nuscenes" else CAMERAS

    def names(self) -> Sequence[str]:
        """List the scenes of the version."""
        return tuple(row["name"] for row in self._tables.scenes)

    def scene(self, name: str) -> Sequence[LogMoment]:
        """Return the key frames of a scene."""
        tables = self._tables
        row = next(each for each in tables.scenes if each["name"] == name)
        messages = self._pose_messages(name)
        return [self._moment(each, messages) for each in tables.samples_of(row)]

    def command_of(self, right_m: float) -> int:
        """Return right, left or straight by the vehicle's later path."""
        right, left, straight = (0, 1, 2) if self.layout == "nuscenes" else (1, 0, 3)
        if abs(right_m) < TURN_M:
            return straight
        return right if right_m > 0 else left

    @functools.cached_property
    def _tables(self) -> NuScenesTables:
        return NuScenesTables(_version_folder(self.root, self.version), self.scenes)

    def _moment(self, sample: Row, messages: Sequence[Row]) -> LogMoment:
        data = self._tables.data[sample["token"]]
        where = f"{self._tables.folder}: sample {sample['token']}"
        for channel in (LIDAR, *self.seen):
            if channel not in data:
                raise FramesError(f"{where} has no {channel}")
        lidar_to_car, car_to_world = self._poses(data[LIDAR])
        lidar_to_world = car_to_world @ lidar_to_car
        # Each camera has its own time, and so its own vehicle pose.
        to_image = dict[str, Floats]()
        for camera in self.seen:
            camera_to_car, there = self._poses(data[camera])
            sensor = self._tables.sensor(data[camera])
            inside = intrinsics(sensor["camera_intrinsic"], f"{where}: {camera}")
            to_camera = np.linalg.inv(there @ camera_to_car)
            to_image[camera] = inside @ to_camera @ lidar_to_world
        # The ego frame lies at the vehicle's centre on the ground.
        to_ego = np.array(lidar_to_car)
        to_ego[:2, 3] = -CENTRE_M * (lidar_to_car[:2, :2] @ [0.0, 1.0])
        return LogMoment(
            time_us=int(sample["timestamp"]),
            pictures={c: self.root / data[c]["filename"] for c in self.seen},
            lidar_to_image=to_image,
            lidar_to_world=lidar_to_world,
            lidar_to_ego=to_ego,
            l2g_rows=True,  # UniAD
            can_bus=self._can_bus(sample, car_to_world, data[LIDAR], messages),
            command=None,
        )

    def _poses(self, data: Row) -> tuple[Floats, Floats]:
        """Return sensor to vehicle and vehicle to world, at the time of the sensor."""
        tables = self._tables
        return tables.pose_of(tables.sensor(data)), tables.pose_of(tables.ego(data))

    def _can_bus(
        self, sample: Row, car_to_world: Floats, lidar: Row, messages: Sequence[Row]
    ) -> Floats:
        bus = np.zeros(CAN_BUS_SIZE)
        # Take the last message before the sample, else the first.
        before = [m for m in messages if m["utime"] <= sample["timestamp"]]
        message = before[-1] if before else next(iter(messages), None)
        if message is not None:
            at = f"{self.root}: CAN bus at {message['utime']}"
            parts = [matrix_of(message[key], (3,), at) for key in CAN_BUS_KEYS]
            if self.layout == "nuscenes":
                bus[7:16] = np.concatenate(parts)
            else:
                bus[7], bus[10:13], bus[13:16] = parts[2][0], parts[0], parts[1]
        # Position and heading come from the vehicle's pose.
        bus[0:3] = car_to_world[:3, 3]
        bus[3:7] = self._tables.ego(lidar)["rotation"]
        heading = math.atan2(car_to_world[1, 0], car_to_world[0, 0]) % (2 * math.pi)
        bus[16], bus[17] = heading, math.degrees(heading)
        return bus

    def _pose_messages(self, scene: str) -> Sequence[Row]:
        for folder in (self.root / "can_bus", self.root.parent / "can_bus"):
            path = folder / f"{scene}_pose.json"
            if path.is_file():
                return list(rows(path, "utime", *CAN_BUS_KEYS))
        return ()


def _version_folder(root: Path, version: str) -> Path:
    if not root.is_dir():
        raise FramesError(f"{root}: no such folder")
    there = sorted(each.name for each in root.glob("v1.0-*") if each.is_dir())
    if version in there:
        return root / version
    if version or len(there) != 1:
        wanted = f"no version {version}" if version else "name the version"
        known = f"there are {', '.join(there)}" if there else "no v1.0-* is in it"
        raise FramesError(f"{root}: {wanted}; {known}")
    return root / there[0]
