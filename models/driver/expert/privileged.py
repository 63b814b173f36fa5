"""What only the expert knows of the world: where actors want to go, and the signals."""

from collections.abc import Collection
from dataclasses import dataclass

import numpy as np

from me2e_compress.base.errors import EvaluationError
from me2e_compress.driving.contract import Observation
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Scene, SignalState
from me2e_compress.simulator.traffic.bodies import Car, Walker
from me2e_compress.simulator.world import World

FORESEEN_M = 90.0


@dataclass(frozen=True, eq=False, slots=True)
class Intent:
    """The plan of one moving actor, by its id in the scene.

    Attributes:
        path: [M, 2] metres: its position, then the way that it will take.
        target_mps: The speed that it wants on this way; 0 while it waits.
        acceleration_mps2: Its present acceleration.
        sees_ego: Whether it brakes for the ego.
    """

    actor_id: int
    path: Floats
    target_mps: float
    acceleration_mps2: float
    sees_ego: bool


@dataclass(frozen=True, slots=True)
class Phase:
    """A signal on the ego's route, by its id in the scene.

    The route crosses its line at the arc length ``line_s``, m; signs have no state.
    """

    signal_id: int
    line_s: float
    state: SignalState | None


@dataclass(frozen=True, slots=True)
class Privileged:
    """What a privileged policy may see besides the scene."""

    intents: tuple[Intent, ...]
    phases: tuple[Phase, ...]


def intent_of(body: Car | Walker) -> Intent:
    """Return what an actor will do if nothing disturbs it."""
    if isinstance(body, Walker):
        target = body.top_speed_mps if body.going and not body.done else 0.0
        return Intent(body.id, body.rest(), target, 0.0, False)
    acceleration = float(body.action["acceleration"])
    forced = body.forced_mps2
    target = float(body.target_speed)
    if forced is not None:
        target = 0.0 if forced < -1.0 else float(body.speed)
    # the centre lines of the lanes ahead
    pieces = [np.array([[body.pose.x, body.pose.y]])]
    skip, found = body.lane_s + body.speed * 0.5 + 1.0, 0.0
    for index in body.lanes[body.leg :]:
        stations, centre = body.network.samples(index)
        length = body.network.length(index)
        ahead = centre[stations > skip]
        if body.offset_m and len(ahead) > 1:
            steps = np.gradient(ahead, axis=0)
            steps /= np.hypot(steps[:, :1], steps[:, 1:])
            left = np.stack([-steps[:, 1], steps[:, 0]], axis=1)
            ahead = ahead + body.offset_m * left
        pieces.append(ahead)
        found += length - max(skip, 0.0)
        skip = max(0.0, skip - length)
        if found > FORESEEN_M:
            break
    way = np.concatenate(pieces)
    return Intent(body.id, way, target, acceleration, body.behaviour.sees_ego)


def privileged(world: World, actors: Collection[int] | None = None) -> Privileged:
    """Return intents, of all or only of some actors, and signal phases."""
    signs = [sign for sign in world.stage.regulators if sign.line_s is not None]
    return Privileged(
        tuple(
            intent_of(body)
            for body in world.stage.bodies
            if actors is None or body.id in actors
        ),
        tuple(Phase(sign.id, sign.line_s or 0.0, sign.state) for sign in signs),
    )


def scene_and_world(observation: Observation, who: str) -> tuple[Scene, World]:
    """Return scene and world, which only privileged policies of highway get."""
    scene, world = observation.scene, observation.world
    if isinstance(scene, Scene) and isinstance(world, World):
        return scene, world
    raise EvaluationError(
        f"{who} needs a highway-env world, and the observation has none"
    )
