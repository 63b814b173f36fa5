"""Observations that a policy gets at each decision."""

import itertools
import math
from dataclasses import dataclass, field
from typing import Self

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.contract import EgoKinematics, Observation, Policy
from me2e_compress.driving.input_sources import can_bus_between
from me2e_compress.simulator.camera_rig import CLEAR, CameraRig, Weather
from me2e_compress.simulator.cameras.ground import paint_texture
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.plane_geometry import RoutePath
from me2e_compress.simulator.scene import ActorKind, Ego, Scene
from me2e_compress.simulator.world import World

APART_M = 50.0
# The most metres of route between two nodes, and how near one counts as reached:
# Bench2Drive's leaderboard thins the plan to 50 m, its agents' RoutePlanner(4.0, 50.0)
# takes nodes off at 4 m
REACHED_M = 4.0


@dataclass(frozen=True, eq=False, slots=True)
class RouteNodes:
    """Nodes where the command changes, every 50 m between them, and at the end.

    ``stations_m`` are ascending arc lengths, ``points`` are [N, 2] (x east, y north).
    """

    stations_m: npt.NDArray[np.float64]
    points: npt.NDArray[np.float64]

    @classmethod
    def along(cls, path: RoutePath) -> Self:
        """Place the nodes of a route."""
        # Stations are the indices of the path's points, a metre apart
        changes = 1 + np.flatnonzero(np.diff(path.commands))
        ends = [0, *changes.tolist(), len(path.points) - 1]
        places: list[int] = []
        for begin, end in itertools.pairwise(ends):
            parts = max(1, math.ceil((end - begin) / APART_M))
            places += [begin + (end - begin) * part // parts for part in range(parts)]
        places = sorted({*places, ends[-1]})
        return cls(np.array(places, float), np.asarray(path.points[places], float))

    def ahead(self, station_m: float, ego: Ego) -> npt.NDArray[np.float32]:
        """Return [2, 2] the next two nodes from an arc length, in the ego frame."""
        last = len(self.points) - 1
        index = int(np.searchsorted(self.stations_m, station_m + REACHED_M, "right"))
        both = self.points[[min(index, last), min(index + 1, last)]]
        return ego.seen(*both.T).astype(np.float32)


def cameras_of(world: World, rig: CameraRig, weather: Weather = CLEAR) -> Cameras:
    """Return the cameras on a route; clear weather is what the route says."""
    texture = paint_texture(world.roadmap, world.path.points)
    return Cameras(texture, rig, world.weather if weather == CLEAR else weather)


@dataclass
class ObservationBuilder:
    """Builds the observations of one route; ``cameras`` is None if unused."""

    world: World
    policy: Policy
    rig: CameraRig
    cameras: Cameras | None
    _last: Ego | None = field(default=None, init=False)
    _nodes: RouteNodes = field(init=False)

    def __post_init__(self) -> None:
        self._nodes = RouteNodes.along(self.world.path)

    def observe(self, scene: Scene) -> Observation:
        """Return the observation at a scene; the CAN bus counts from the last call."""
        shown = self.cameras if self.policy.needs_images else None
        can_bus = can_bus_of(scene.ego, self._last)
        self._last = scene.ego
        return Observation(
            scene.time_us,
            None if shown is None else shown.render(scene),
            self.rig.lidar2img,
            can_bus,
            int(self.world.path.command_at(self.world.ego_s)),
            scene.ego.speed_mps,
            scene if self.policy.privileged else None,
            self.world if self.policy.privileged else None,
            motion_of(scene.ego),
            self._nodes.ahead(self.world.ego_s, scene.ego),
        )


# Actors that no tracker would follow
THINGS = ActorKind.DOOR, ActorKind.CONE, ActorKind.BARRIER


def road_users(scene: Scene) -> npt.NDArray[np.float64]:
    """Return [N, 2] positions of road users, metres in the ego frame."""
    places = [(actor.x, actor.y) for actor in scene.actors if actor.kind not in THINGS]
    return scene.ego.seen(*np.array(places, np.float64).reshape(-1, 2).T)


def can_bus_of(ego: Ego, last: Ego | None) -> npt.NDArray[np.float32]:
    """Return float32 [18], see `Observation`; ``last`` is the ego a decision ago."""
    return can_bus_between(motion_of(ego), None if last is None else motion_of(last))


def motion_of(ego: Ego) -> EgoKinematics:
    """Return the ego's place and motion."""
    pushes = ego.acceleration_mps2, ego.lateral_acceleration_mps2, 0.0
    turns = 0.0, 0.0, ego.yaw_rate_radps
    return EgoKinematics(ego.x, ego.y, ego.heading, ego.speed_mps, pushes, turns)
