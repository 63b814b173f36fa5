"""Snapshots of the world at one instant: frozen, metric, right-handed.

The plane is x east, y north, headings in radians counter-clockwise from east; the ego
frame is x forward, y left. highway-env's own world has its y axis pointing down; only
`world` knows that, and converts once when it takes a snapshot.
"""

import math
from dataclasses import dataclass
from enum import IntEnum, StrEnum

import numpy as np

from me2e_compress.simulator.plane_geometry import Floats


class ActorKind(StrEnum):
    """What an actor is; its size comes from `DIMENSIONS` unless a script sets it."""

    CAR = "car"
    VAN = "van"
    TRUCK = "truck"
    EMERGENCY = "emergency"
    BICYCLE = "bicycle"
    PEDESTRIAN = "pedestrian"
    PARKED = "parked"  # a car without a driver; never moves
    DOOR = "door"  # the open door of a parked car
    CONE = "cone"
    BARRIER = "barrier"


Size = tuple[float, float, float]  # length, width and height in metres
# nuScenes' mean boxes (the anchor sizes of
# CenterPoint's nuScenes configuration, github.com/tianweiy/CenterPoint); van and
# emergency vehicle after a long-wheelbase delivery van; the door is our choice
DIMENSIONS: dict[ActorKind, Size] = {
    ActorKind.CAR: (4.6, 1.95, 1.73),
    ActorKind.VAN: (5.3, 2.0, 2.1),
    ActorKind.TRUCK: (6.93, 2.51, 2.84),
    ActorKind.EMERGENCY: (5.3, 2.0, 2.3),
    ActorKind.BICYCLE: (1.7, 0.6, 1.28),
    ActorKind.PEDESTRIAN: (0.73, 0.67, 1.77),
    ActorKind.PARKED: (4.6, 1.95, 1.73),
    ActorKind.DOOR: (0.2, 1.0, 1.2),
    ActorKind.CONE: (0.41, 0.41, 1.07),
    ActorKind.BARRIER: (0.5, 2.53, 0.98),
}


class SignalKind(StrEnum):
    """What regulates a stop line."""

    TRAFFIC_LIGHT = "traffic_light"
    STOP_SIGN = "stop_sign"
    GIVE_WAY = "give_way"


class SignalState(StrEnum):
    """Phase of a traffic light."""

    RED = "red"
    YELLOW = "yellow"
    GREEN = "green"


@dataclass(frozen=True, slots=True)
class Control:
    """What the ego's driver asks for; the actuators follow with a lag."""

    acceleration_mps2: float
    steering_rad: float  # front wheel angle, positive to the left


@dataclass(frozen=True, slots=True)
class Actor:
    """A box that is not the ego. The position is the centre of the box."""

    id: int
    kind: ActorKind
    x: float
    y: float
    heading: float
    speed_mps: float
    length: float
    width: float
    height: float
    braking: bool
    indicator: int  # -1 right, 0 off, +1 left


@dataclass(frozen=True, slots=True)
class Ego:
    """State of the ego. The position is the centre of the box."""

    x: float
    y: float
    heading: float
    speed_mps: float
    acceleration_mps2: float
    lateral_acceleration_mps2: float  # positive to the left
    yaw_rate_radps: float
    steering_rad: float  # front wheel angle, held by the actuator; left is positive
    length: float
    width: float

    def seen(self, x: Floats, y: Floats) -> Floats:
        """Convert points of the world to the ego frame: [..., 2], forward and left."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        dx, dy = x - self.x, y - self.y
        return np.stack([cos * dx + sin * dy, cos * dy - sin * dx], axis=-1)

    def placed(self, points: Floats) -> Floats:
        """Convert [N, 2] points of the ego frame to the world."""
        cos, sin = math.cos(self.heading), math.sin(self.heading)
        turn = np.array([[cos, sin], [-sin, cos]])
        return np.asarray(points @ turn + (self.x, self.y))


def box_of(body: Actor | Ego) -> tuple[float, float, float, float, float]:
    """Return x, y, heading, length and width."""
    return body.x, body.y, body.heading, body.length, body.width


@dataclass(frozen=True, slots=True)
class Signal:
    """A light or a sign with the line at which it must be obeyed."""

    id: int
    kind: SignalKind
    x: float
    y: float
    heading: float  # of the traffic that must obey, not the way the lamp faces
    state: SignalState | None  # None for signs
    stop_line: tuple[tuple[float, float], tuple[float, float]]


@dataclass(frozen=True, slots=True)
class Scene:
    """Everything at one instant."""

    time_us: int
    ego: Ego
    actors: tuple[Actor, ...]
    signals: tuple[Signal, ...]


class EventKind(StrEnum):
    """Kinds of events."""

    TRIGGER = "trigger"  # a scenario's script began to act
    COLLISION = "collision"  # the ego with another body
    ACTOR_COLLISION = "actor_collision"  # two others; never in a well-written scenario
    STRUCK = "struck"  # another body with the standing ego; counts against nobody
    OUTSIDE_LANES = "outside_lanes"
    RED_LIGHT = "red_light"
    STOP_SIGN = "stop_sign"
    GIVE_WAY = "give_way"
    YIELD_EMERGENCY = "yield_emergency"


# Events that count against the driver
INFRACTIONS: frozenset[EventKind] = frozenset(EventKind) - {
    EventKind.TRIGGER,
    EventKind.ACTOR_COLLISION,
    EventKind.STRUCK,
}


@dataclass(frozen=True, slots=True)
class Event:
    """One event; the actor is the other party, if any."""

    time_us: int
    kind: EventKind
    detail: str  # the script's name, or what happened in words
    x: float  # the ego's position, metres
    y: float
    ego_speed_mps: float
    actor_id: int | None = None
    actor_kind: ActorKind | None = None


# Classes of what lies on the ground.


class PixelClass(IntEnum):
    """Values of the uint8 class rasters seen from above."""

    TERRAIN = 1
    SHOULDER = 2  # paved but no lane
    DRIVABLE = 3
    LANE_MARKING = 4
    STOP_LINE = 5
    CROSSWALK = 6  # the white bars
    VEHICLE = 7
    BICYCLE = 8
    PEDESTRIAN = 9
    STATIC = 10  # cones, barriers
    EGO = 13
