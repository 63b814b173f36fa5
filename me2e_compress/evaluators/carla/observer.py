"""CARLA's sensors to an observation: the only source of what a model sees.

Importing it without OpenCV raises MissingExtraError.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from importlib.util import find_spec
from typing import Any

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import EgoKinematics, Observation
from me2e_compress.driving.ego_track import can_bus_between
from me2e_compress.errors import MissingExtraError
from me2e_compress.evaluators.carla.interface import SensorData
from me2e_compress.evaluators.carla.rig import GPS, IMU, SPEED, CarlaRig, Triple
from me2e_compress.evaluators.carla.route_follower import GeoReference, RouteFollower

if find_spec("cv2") is None:
    raise MissingExtraError("cv2", "highway")

import cv2

Images = npt.NDArray[np.uint8]


@dataclass(frozen=True, slots=True)
class CarlaReading:
    """What the cheap sensors say at one tick, in a right-handed world.

    ``command`` is where the route goes next, 0 to 5; ``node`` is the next node of the
    route, metres to the right and forward, and ``node_after`` the one after it (at the
    end of the route the same).
    """

    motion: EgoKinematics
    command: int
    node: tuple[float, float]
    node_after: tuple[float, float]


class RouteReader:
    """Reads the cheap sensors at every tick, and follows the route with them.

    It takes the leaderboard's plan in both forms: ``gps_plan`` has ({"lat", "lon"},
    RoadOption) by node, ``world_plan`` (transform, RoadOption) of the same nodes.
    """

    def __init__(
        self, gps_plan: Sequence[tuple[Any, Any]], world_plan: Sequence[tuple[Any, Any]]
    ) -> None:
        places = [(at.location.x, -at.location.y, option) for at, option in world_plan]
        first = gps_plan[0][0]
        self._geo = GeoReference.through(first["lat"], first["lon"], *places[0][:2])
        self._follower = RouteFollower(places)

    def read(self, sensors: SensorData) -> CarlaReading:
        """Return what GPS, IMU and speedometer say at one tick."""
        # position, heading and motion, in a right-handed world
        latitude, longitude, *_ = sensors[GPS][1]
        x, y = self._geo.metres(latitude, longitude)
        imu = [float(value) for value in sensors[IMU][1]]
        if math.isnan(imu[6]):  # as it is in the first frames
            imu = [0.0] * 7
        # the compass turns clockwise from north
        heading = math.pi / 2 - imu[6]
        forward, right, up = imu[:3]
        motion = EgoKinematics(
            x,
            y,
            heading,
            float(sensors[SPEED][1]["speed"]),
            (forward, -right, up),
            # Bench2Drive's agents turn all three round
            (-imu[3], -imu[4], -imu[5]),
        )
        # the next two nodes of the route, to the right and forward
        place, command = self._follower.next(x, y)
        nodes = np.stack([place, self._follower.after_next]) - (x, y)
        sin, cos = math.sin(heading), math.cos(heading)
        near, far = nodes @ np.array([[sin, cos], [-cos, sin]])
        return CarlaReading(motion, command, (near[0], near[1]), (far[0], far[1]))


@dataclass
class CarlaObserver:
    """Makes observations as the contract has them, of six cameras.

    Cameras that are not in ``seen`` stay black; without any there are no images.
    ``origin_m`` is the origin of the model's ground frame in the ego frame. Every image
    is encoded and decoded as a JPEG of ``jpeg_quality``, as Bench2Drive's agents do to
    match their training data; 0 leaves it as it is. ``fill`` is the padding's colour,
    R, G, B.
    """

    rig: CarlaRig
    seen: tuple[int, ...]
    origin_m: Triple
    jpeg_quality: int
    fill: tuple[int, ...] = (0, 0, 0)
    _last: EgoKinematics | None = field(default=None, init=False)

    def __post_init__(self) -> None:
        """Compute the projection, which never changes."""
        self._lidar2img = self.rig.lidar2img(self.origin_m)

    def observe(
        self, sensors: SensorData, reading: CarlaReading, time_us: int
    ) -> Observation:
        """Return the observation; its CAN bus counts from the previous one."""
        can_bus = can_bus_between(reading.motion, self._last)
        self._last = reading.motion
        return Observation(
            time_us,
            self._images(sensors) if self.seen else None,
            self._lidar2img,
            can_bus,
            reading.command,
            reading.motion.speed_mps,
            motion=reading.motion,
            target_points=_ego_frame(reading.node, reading.node_after),
        )

    def _images(self, sensors: SensorData) -> Images:
        images = np.zeros((len(self.rig.cameras), *self.rig.taken, 3), np.uint8)
        for place in self.seen:
            images[place] = self._taken(sensors[self.rig.cameras[place].id][1])
        return images

    def _taken(self, bgra: Images) -> Images:
        """Convert one picture, BGRA [rows, columns, 4], to RGB of the model's size."""
        picture = np.asarray(cv2.cvtColor(bgra, cv2.COLOR_BGRA2RGB))
        if self.jpeg_quality:
            # red and blue swapped, as in those agents: chroma is what it costs
            quality = (cv2.IMWRITE_JPEG_QUALITY, self.jpeg_quality)
            _, content = cv2.imencode(".jpg", picture, quality)
            picture = np.asarray(cv2.imdecode(content, cv2.IMREAD_COLOR))
        columns, rows = (round(side * self.rig.scale) for side in self.rig.rendered)
        smaller = cv2.resize(picture, (columns, rows), interpolation=cv2.INTER_LINEAR)
        taken = np.empty((*self.rig.taken, 3), np.uint8)
        taken[:] = self.fill
        taken[:rows, :columns] = smaller
        return taken


def _ego_frame(*places: tuple[float, float]) -> npt.NDArray[np.float32]:
    """Convert positions (right, forward) to [n, 2] of the ego frame."""
    return np.array([(forward, -right) for right, forward in places], np.float32)
