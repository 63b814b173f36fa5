"""Bodies that follow no lane: the ego, pedestrians, static objects."""

import bisect
import math
from dataclasses import dataclass, field

import numpy as np
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle, RoadObject

from me2e_compress.simulator.bicycle import MAX_STEERING_RAD, curvature_of, slip_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import (
    DIMENSIONS,
    ActorKind,
    Control,
    Ego,
)
from me2e_compress.simulator.traffic.network import Pose, flip

GRAVITY_MPS2 = 9.81
DRY_GRIP_MPS2 = 0.8 * GRAVITY_MPS2
"""Largest acceleration that the tyres transmit: friction 0.8, dry asphalt."""
ACCELERATION_RANGE_MPS2 = (-8.0, 4.0)
"""Limits of the ego's brakes and engine."""
ACCELERATION_LAG_S = 0.2
STEERING_LAG_S = 0.1
"""Time constants of the ego's first-order actuators: our choice. highway-env acts at
once, which makes jerk, and so every comfort score, meaningless."""


class EgoVehicle(Vehicle):  # type: ignore[misc]  # highway-env is untyped
    """The ego: highway-env's kinematic bicycle with lag, grip and no reverse gear.

    The dynamics are exact for held actuators, so a finer time step changes the
    trajectory by the held control alone.
    """

    def __init__(self, pose: Pose, speed_mps: float) -> None:
        super().__init__(None, flip(pose.x, pose.y), -pose.heading, speed_mps)
        self.speed: float = speed_mps
        self.position: Floats
        self.id = 0
        self.kind = ActorKind.CAR
        self.grip_mps2 = DRY_GRIP_MPS2
        self.wanted = Control(0.0, 0.0)
        self.acceleration_mps2 = 0.0
        self.yaw_rate_radps = 0.0
        self.steering_rad = 0.0
        self._thrust_mps2 = 0.0

    @property
    def pose(self) -> Pose:
        """Right-handed pose."""
        x, y = self.position
        return Pose(float(x), -float(y), -float(self.heading))

    def act(self, action: object = None) -> None:
        """Do nothing: the ego is driven from outside through `wanted`."""

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        # actuators follow with a lag
        low, high = ACCELERATION_RANGE_MPS2
        thrust = min(max(self.wanted.acceleration_mps2, low), high)
        wheel = min(max(self.wanted.steering_rad, -MAX_STEERING_RAD), MAX_STEERING_RAD)
        follow = 1 - math.exp(-dt / ACCELERATION_LAG_S)
        self._thrust_mps2 += follow * (thrust - self._thrust_mps2)
        self.steering_rad += (1 - math.exp(-dt / STEERING_LAG_S)) * (
            wheel - self.steering_rad
        )
        # speed, limited by grip
        pushed = min(max(self._thrust_mps2, -self.grip_mps2), self.grip_mps2)
        before = float(self.speed)
        after = max(0.0, before + pushed * dt)
        mean = (before + after) / 2
        # curvature, limited by grip
        slip = slip_of(self.steering_rad)
        curvature = curvature_of(self.steering_rad, self.LENGTH)
        tightest = self.grip_mps2 / max(mean, 0.1) ** 2
        if abs(curvature) > tightest:
            curvature = math.copysign(tightest, curvature)
            slip = math.asin(curvature * self.LENGTH / 2)
        turn = mean * curvature * dt
        # pose, in highway-env's plane
        course = -self.heading + slip + turn / 2
        self.position = self.position + mean * dt * flip(
            math.cos(course), math.sin(course)
        )
        self.heading -= turn
        self.speed = after
        self.acceleration_mps2 = (after - before) / dt
        self.yaw_rate_radps = mean * curvature

    def snapshot(self) -> Ego:
        """Return the state, right-handed."""
        pose = self.pose
        return Ego(
            pose.x,
            pose.y,
            pose.heading,
            float(self.speed),
            self.acceleration_mps2,
            float(self.speed) * self.yaw_rate_radps,
            self.yaw_rate_radps,
            self.steering_rad,
            float(self.LENGTH),
            float(self.WIDTH),
        )


class Walker(Vehicle):  # type: ignore[misc]  # highway-env is untyped
    """A pedestrian or cyclist who follows a polyline once started and never yields.

    ``line`` is [N, 2] right-handed metres.
    """

    def __init__(
        self, id: int, kind: ActorKind, line: Floats, speed_mps: float
    ) -> None:
        step = line[1] - line[0]
        heading = math.atan2(step[1], step[0])
        super().__init__(None, flip(*line[0]), -heading, 0.0)
        self.speed: float = 0.0
        self.position: Floats
        self.LENGTH, self.WIDTH, self.height = DIMENSIONS[kind]
        self.diagonal = math.hypot(self.LENGTH, self.WIDTH)
        self.id, self.kind, self.line = id, kind, line
        self.top_speed_mps = speed_mps
        self.going = self.crosses = False
        self.walked_m = 0.0
        self.braking, self.indicator = False, 0
        legs = np.hypot(*np.diff(line, axis=0).T)
        self._arc = np.concatenate([[0.0], np.cumsum(legs)])
        self._ends = self._arc.tolist()
        self._columns = line[:, 0].tolist(), line[:, 1].tolist()

    @property
    def done(self) -> bool:
        """Whether the end of the line is reached."""
        return bool(self.walked_m >= self._ends[-1])

    def act(self, action: object = None) -> None:
        """Do nothing: only `going` matters."""

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds; walking speed is reached within 0.5 s."""
        target = self.top_speed_mps if self.going and not self.done else 0.0
        if target == self.speed == 0.0:
            return
        change = 2 * max(self.top_speed_mps, 1.0) * dt
        self.speed += min(max(target - self.speed, -change), change)
        self.walked_m = min(self.walked_m + self.speed * dt, self._ends[-1])
        if self.done:
            self.speed = 0.0
        x, y, course = self._place()
        self.heading = -course
        self.position = flip(x, y)

    def _place(self) -> tuple[float, float, float]:
        """Return where it is on its line, and the direction there, in plain floats."""
        ends, (xs, ys) = self._ends, self._columns
        leg = min(max(bisect.bisect_right(ends, self.walked_m) - 1, 0), len(ends) - 2)
        dx, dy = xs[leg + 1] - xs[leg], ys[leg + 1] - ys[leg]
        course = math.atan2(dy, dx)
        if self.walked_m >= ends[-1]:
            return xs[-1], ys[-1], course
        length, along = ends[leg + 1] - ends[leg], self.walked_m - ends[leg]
        return dx / length * along + xs[leg], dy / length * along + ys[leg], course

    def rest(self) -> Floats:
        """Return [M, 2], the rest of its line from its position on."""
        ahead = self.line[self._arc > self.walked_m]
        return np.concatenate([flip(*self.position)[None], ahead])


class StaticObject(Obstacle):  # type: ignore[misc]  # highway-env is untyped
    """A static object: parked car, door, cone, barrier."""

    def __init__(
        self,
        id: int,
        kind: ActorKind,
        pose: Pose,
        size: tuple[float, float, float] | None = None,
    ) -> None:
        super().__init__(None, flip(pose.x, pose.y), -pose.heading, 0.0)
        self.LENGTH, self.WIDTH, self.height = size or DIMENSIONS[kind]
        self.diagonal = math.hypot(self.LENGTH, self.WIDTH)
        self.id, self.kind = id, kind
        self.braking, self.indicator = False, 0


# Contacts of an ego that drives on after a collision.


SAME_US = 5_000_000
SAME_M = 5.0
"""A contact with the same actor within 5 s of the last, or with any within 5 m of the
last collision, is no other collision: CollisionTest in atomic_criteria.py."""
DEEPER_M = 1e-3


@dataclass
class Contacts:
    """Which contacts count, and what they do to the ego."""

    _last_us: dict[int, int] = field(default_factory=dict)
    _place: Floats | None = None
    _position: Floats = field(default_factory=lambda: np.zeros(2))
    _heading: float = 0.0

    def before(self, ego: EgoVehicle) -> None:
        """Remember where the ego is before it moves."""
        self._position, self._heading = ego.position.copy(), float(ego.heading)

    def resist(self, ego: EgoVehicle, body: RoadObject) -> None:
        """Put the ego back if it moved farther into a body; then it stands."""
        now = depth(ego.position, ego.heading, ego, body)
        then = depth(self._position, self._heading, ego, body)
        if then > 0.0 and now > then + DEEPER_M:
            ego.position, ego.heading = self._position.copy(), self._heading
            ego.speed = 0.0

    def counts(self, time_us: int, ego: EgoVehicle, body: int) -> bool:
        """Return whether a contact is a collision of its own, and remember it."""
        last = self._last_us.get(body)
        self._last_us[body] = time_us
        place = self._place
        near = place is not None and np.hypot(*(ego.position - place)) < SAME_M
        if near or (last is not None and time_us - last < SAME_US):
            return False
        self._place = ego.position.copy()
        return True


def depth(place: Floats, heading: float, ego: EgoVehicle, body: RoadObject) -> float:
    """Return how deep (m) a body is in the ego at a pose; 0 or less if they are apart.

    It is the least overlap along the axes of both rectangles.
    """
    dx, dy = (float(value) for value in body.position - place)
    turn = float(body.heading - heading)
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    least = math.inf
    for at, one, other in ((heading, ego, body), (float(body.heading), body, ego)):
        ch, sh = math.cos(at), math.sin(at)
        along, across = abs(dx * ch + dy * sh), abs(dy * ch - dx * sh)
        least = min(
            least,
            (one.LENGTH + other.LENGTH * c + other.WIDTH * s) / 2 - along,
            (one.WIDTH + other.LENGTH * s + other.WIDTH * c) / 2 - across,
        )
    return least
