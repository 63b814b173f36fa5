"""What only a privileged policy may see: the plans of actors, signal phases."""

from dataclasses import dataclass

import numpy as np

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import SignalState
from me2e_compress.simulator.traffic.bodies import Walker
from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.signals import Regulator

FORESEEN_M = 90.0


@dataclass(frozen=True, eq=False, slots=True)
class Intent:
    """The plan of one moving actor.

    Attributes:
        actor_id: As in the scene.
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
    """A signal on the ego's route.

    Attributes:
        signal_id: As in the scene.
        line_s: Arc length at which the route crosses its line, m.
        state: Phase of a light, None for signs.
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
    return Intent(body.id, _way(body), target, acceleration, body.behaviour.sees_ego)


def phase_of(regulator: Regulator) -> Phase | None:
    """Return a signal on the ego's route; None if the route does not meet it."""
    if regulator.line_s is None:
        return None
    return Phase(regulator.id, regulator.line_s, regulator.state)


def _way(car: Car) -> Floats:
    """Return the centre lines of the lanes ahead of the car."""
    pieces = [np.array([[car.pose.x, car.pose.y]])]
    skip, found = car.lane_s + car.speed * 0.5 + 1.0, 0.0
    for index in car.lanes[car.leg :]:
        stations, centre = car.network.samples(index)
        length = car.network.length(index)
        ahead = centre[stations > skip]
        if car.offset_m and len(ahead) > 1:
            ahead = ahead + car.offset_m * _normals(ahead)
        pieces.append(ahead)
        found += length - max(skip, 0.0)
        skip = max(0.0, skip - length)
        if found > FORESEEN_M:
            break
    return np.concatenate(pieces)


def _normals(points: Floats) -> Floats:
    """Return [N, 2] unit vectors to the left of a polyline."""
    steps = np.gradient(points, axis=0)
    steps /= np.hypot(steps[:, :1], steps[:, 1:])
    return np.stack([-steps[:, 1], steps[:, 0]], axis=1)
