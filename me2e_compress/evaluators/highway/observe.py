"""Observations that a policy gets at each decision."""

import math
from dataclasses import dataclass, field

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.can_bus import can_bus_between
from me2e_compress.driving.contract import Observation, Policy
from me2e_compress.driving.ego_kinematics import EgoKinematics
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.route_nodes import RouteNodes
from me2e_compress.simulator.cameras import CameraRig, Cameras
from me2e_compress.simulator.scene import ActorKind, Ego, Scene
from me2e_compress.simulator.world import World


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
        """Return what the policy sees at this scene; call it once per decision.

        The CAN bus counts metres and degrees since the last call.
        """
        images = self.cameras.render(scene) if self.cameras is not None else None
        can_bus = can_bus_of(scene.ego, self._last)
        self._last = scene.ego
        return Observation(
            scene.time_us,
            images if self.policy.needs_images else None,
            self.rig.lidar2img,
            can_bus,
            int(self.world.path.command_at(self.world.ego_s)),
            scene.ego.speed_mps,
            scene if self.policy.privileged else None,
            self.world if self.policy.privileged else None,
            motion_of(scene.ego),
            self._nodes.ahead(self.world.ego_s, scene.ego),
        )


ROAD_USERS = (
    ActorKind.CAR,
    ActorKind.VAN,
    ActorKind.TRUCK,
    ActorKind.EMERGENCY,
    ActorKind.BICYCLE,
    ActorKind.PEDESTRIAN,
    ActorKind.PARKED,
)
"""Actors that a tracker would follow: all but doors, cones and barriers."""


def road_users(scene: Scene) -> npt.NDArray[np.float64]:
    """Return [N, 2] positions of road users, metres in the ego frame."""
    ego = scene.ego
    found = [each for each in scene.actors if each.kind in ROAD_USERS]
    away = np.array([(each.x - ego.x, each.y - ego.y) for each in found], np.float64)
    cos, sin = math.cos(ego.heading), math.sin(ego.heading)
    return np.asarray(away.reshape(-1, 2) @ np.array([[cos, -sin], [sin, cos]]))


def scene_and_world(observation: Observation, who: str) -> tuple[Scene, World]:
    """Return scene and world, which only privileged policies of highway get."""
    scene, world = observation.scene, observation.world
    if isinstance(scene, Scene) and isinstance(world, World):
        return scene, world
    raise EvaluationError(
        f"{who} needs a highway-env world, and the observation has none"
    )


def can_bus_of(ego: Ego, last: Ego | None) -> npt.NDArray[np.float32]:
    """Return float32 [18], see `Observation`; ``last`` is the ego a decision ago."""
    return can_bus_between(motion_of(ego), None if last is None else motion_of(last))


def motion_of(ego: Ego) -> EgoKinematics:
    """Return the ego's place and motion."""
    return EgoKinematics(
        ego.x,
        ego.y,
        ego.heading,
        ego.speed_mps,
        (ego.acceleration_mps2, ego.lateral_acceleration_mps2, 0.0),
        (0.0, 0.0, ego.yaw_rate_radps),
    )
