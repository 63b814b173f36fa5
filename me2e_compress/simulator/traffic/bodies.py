"""All bodies: the ego, pedestrians and static objects, and cars on their lanes."""

import bisect
import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.kinematics import Vehicle
from highway_env.vehicle.objects import Obstacle, RoadObject

from me2e_compress.simulator.bicycle import MAX_STEERING_RAD, curvature_of, slip_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import DIMENSIONS, ActorKind, Control, Ego, Size
from me2e_compress.simulator.traffic.network import LaneIndex, Network, Pose, flip

GRAVITY_MPS2 = 9.81
DRY_GRIP_MPS2 = 0.8 * GRAVITY_MPS2  # of tyres on dry asphalt: friction 0.8
ACCELERATION_RANGE_MPS2 = (-8.0, 4.0)  # limits of the ego's brakes and engine
ACCELERATION_LAG_S = 0.2
# Time constants of the ego's first-order actuators: our choice. highway-env acts at
# once, which makes jerk, and so every comfort score, meaningless.
STEERING_LAG_S = 0.1
# Lateral acceleration at which actors take a curve: our choice, half the comfort bound
# of nuPlan (4.89)
LATERAL_COMFORT_MPS2 = 2.5
LOOK_AHEAD_M = 70.0


class _Body:
    """What bodies have of their own beside highway-env's."""

    position: Floats
    heading: float
    braking, indicator = False, 0

    @property
    def pose(self) -> Pose:
        """Right-handed pose."""
        x, y = self.position
        return Pose(float(x), -float(y), -float(self.heading))

    @property
    def box(self) -> tuple[float, float, float, float, float]:
        """Its x, y, heading, length and width in highway-env's plane."""
        return (*self.position, self.heading, self.LENGTH, self.WIDTH)

    def become(self, id: int, kind: ActorKind, size: Size | None = None) -> None:
        """Set identity and size."""
        self.id, self.kind = id, kind
        self.LENGTH, self.WIDTH, self.height = size or DIMENSIONS[kind]
        self.diagonal = math.hypot(self.LENGTH, self.WIDTH)

    def act(self, action: object = None) -> None:
        """Decide nothing: the ego is driven from outside, walkers by scripts."""


class EgoVehicle(_Body, Vehicle):  # type: ignore[misc]  # highway-env is untyped
    """The ego: highway-env's kinematic bicycle with lag, grip and no reverse gear."""

    # The dynamics are exact for held actuators, so a finer time step changes the
    # trajectory by the held control alone

    def __init__(self, pose: Pose, speed_mps: float) -> None:
        super().__init__(None, flip(pose.x, pose.y), -pose.heading, speed_mps)
        self.speed: float = speed_mps
        self.id, self.kind = 0, ActorKind.CAR
        self.grip_mps2 = DRY_GRIP_MPS2
        self.wanted = Control(0.0, 0.0)
        self.acceleration_mps2 = 0.0
        self.yaw_rate_radps = 0.0
        self.steering_rad = 0.0
        self._thrust_mps2 = 0.0

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds."""
        # actuators follow with a lag
        low, high = ACCELERATION_RANGE_MPS2
        thrust = min(max(self.wanted.acceleration_mps2, low), high)
        wheel = min(max(self.wanted.steering_rad, -MAX_STEERING_RAD), MAX_STEERING_RAD)
        follow = 1 - math.exp(-dt / ACCELERATION_LAG_S)
        self._thrust_mps2 += follow * (thrust - self._thrust_mps2)
        turn_in = 1 - math.exp(-dt / STEERING_LAG_S)
        self.steering_rad += turn_in * (wheel - self.steering_rad)
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
        direction = flip(math.cos(course), math.sin(course))
        self.position = self.position + mean * dt * direction
        self.heading -= turn
        self.speed = after
        self.acceleration_mps2 = (after - before) / dt
        self.yaw_rate_radps = mean * curvature

    def snapshot(self) -> Ego:
        """Return the state, right-handed."""
        pose, speed, yaw_rate = self.pose, float(self.speed), self.yaw_rate_radps
        accelerations = self.acceleration_mps2, speed * yaw_rate
        turning = yaw_rate, self.steering_rad
        motion = pose.x, pose.y, pose.heading, speed, *accelerations, *turning
        return Ego(*motion, float(self.LENGTH), float(self.WIDTH))


class Walker(_Body, Vehicle):  # type: ignore[misc]  # highway-env is untyped
    """A pedestrian or cyclist who follows a polyline once started and never yields."""

    def __init__(
        self, id: int, kind: ActorKind, line: Floats, speed_mps: float
    ) -> None:
        step = line[1] - line[0]
        heading = math.atan2(step[1], step[0])
        super().__init__(None, flip(*line[0]), -heading, 0.0)
        self.speed: float = 0.0
        self.become(id, kind)
        self.line = line  # (n, 2) metres, right-handed
        self.top_speed_mps = speed_mps
        self.going = self.crosses = False
        self.walked_m = 0.0
        legs = np.diff(line, axis=0)
        self._arc = np.concatenate([[0.0], np.cumsum(np.hypot(*legs.T))])
        self._ends = self._arc.tolist()
        # Of each leg: where it begins, its direction, and its heading
        ways = np.hstack([line[:-1], legs / np.diff(self._arc)[:, None]]).tolist()
        headings = (-math.atan2(dy, dx) for dx, dy in legs.tolist())
        self._legs = [*zip(ways, headings, strict=True)]

    @property
    def done(self) -> bool:
        """Whether the end of the line is reached."""
        return bool(self.walked_m >= self._ends[-1])

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds; walking speed is reached within 0.5 s."""
        ends, top = self._ends, self.top_speed_mps
        target = top if self.going and self.walked_m < ends[-1] else 0.0
        if target == self.speed == 0.0:
            return
        change = 2 * max(top, 1.0) * dt
        self.speed += min(max(target - self.speed, -change), change)
        self.walked_m = min(self.walked_m + self.speed * dt, ends[-1])
        if self.done:
            self.speed = 0.0
        # where it is on its line, and the direction there, in plain floats
        leg = min(max(bisect.bisect_right(ends, self.walked_m) - 1, 0), len(ends) - 2)
        (x, y, way_x, way_y), self.heading = self._legs[leg]
        along = self.walked_m - ends[leg]
        x, y = way_x * along + x, way_y * along + y
        self.position = flip(*self.line[-1]) if self.done else flip(x, y)

    def rest(self) -> Floats:
        """Return [M, 2], the rest of its line from its position on."""
        ahead = self.line[self._arc > self.walked_m]
        return np.concatenate([flip(*self.position)[None], ahead])


class StaticObject(_Body, Obstacle):  # type: ignore[misc]  # highway-env is untyped
    """A static object: parked car, door, cone, barrier. It never moves."""

    def __init__(
        self, id: int, kind: ActorKind, pose: Pose, size: Size | None = None
    ) -> None:
        super().__init__(None, flip(pose.x, pose.y), -pose.heading, 0.0)
        self.become(id, kind, size)


# Cars that follow lanes by highway-env's IDM, each with its own behaviour. What stock
# `IDMVehicle` gets wrong and this one does not (highway-env 1.12): its parameters are
# class attributes that one environment changes under another; it reverses when cut off;
# it draws random numbers where no route is given; it shares one route list between
# cars; and it measures the gap in the coordinates of its own lane even where the leader
# is around the corner.


@dataclass(frozen=True, slots=True)
class Behaviour:
    """IDM parameters of one car; defaults are highway-env's but for the gaps."""

    # highway-env's jam distance of 10 m is measured between centres; ours between
    # bumpers
    acceleration_mps2: float = 3.0
    braking_mps2: float = 5.0
    hardest_mps2: float = 8.0
    jam_gap_m: float = 2.5
    headway_s: float = 1.2
    sees_ego: bool = True  # False for actors that ignore the ego
    obeys_limits: bool = True  # False for emergency vehicles
    obeys_rules: bool = True  # False for those who pass red lights and priority traffic
    gap_s: float = 1.2  # time to spare before priority traffic
    changes_lanes: bool = False  # whether MOBIL looks for a better lane
    politeness: float = 0.0  # MOBIL's weight of others; highway-env has 0


class Car(_Body, IDMVehicle):  # type: ignore[misc]  # highway-env is untyped
    """An actor on a chain of lanes, each the successor of the one before.

    It starts at an arc length on the first of them; it wants to go on at its initial
    speed unless a target says otherwise. The kind decides its size.
    """

    def __init__(
        self,
        id: int,
        network: Network,
        lanes: Sequence[LaneIndex],
        s_m: float,
        speed_mps: float,
        target_mps: float | None = None,
        kind: ActorKind = ActorKind.CAR,
        behaviour: Behaviour | None = None,
    ) -> None:
        pose = network.pose(lanes[0], s_m)
        super().__init__(None, flip(pose.x, pose.y), -pose.heading, speed_mps)
        self.become(id, kind)
        self.network = network
        self.speed: float = speed_mps
        # highway-env's IDM reads these names
        self.behaviour = behaviour or Behaviour()
        self.COMFORT_ACC_MAX = self.behaviour.acceleration_mps2
        self.COMFORT_ACC_MIN = -self.behaviour.braking_mps2
        self.DISTANCE_WANTED = self.behaviour.jam_gap_m
        self.TIME_WANTED = self.behaviour.headway_s
        # its way, and what scripts may change
        self.target_speed = speed_mps if target_mps is None else target_mps
        self.lanes, self.leg = list(lanes), 0
        self.target_lane_index = self.lane_index = self.lanes[0]
        self.action = {"acceleration": 0.0, "steering": 0.0}
        self.forced_mps2: float | None = None  # by a script, instead of IDM's
        self.offset_m = 0.0  # how far left of the lane's centre it drives
        self.until_change = id % 10  # decisions until it looks for a better lane
        self.joins: list[LaneIndex] | None = None  # where its own chain ends

    @property
    def lane_s(self) -> float:
        """Arc length in the present lane."""
        lane = self.network.lane(self.lanes[self.leg])
        return float(lane.local_coordinates(self.position)[0])

    @property
    def gone(self) -> bool:
        """Whether it has left its last lane."""
        last = self.leg == len(self.lanes) - 1
        return last and self.lane_s > self.network.length(self.lanes[-1])

    def change_lane(self, lanes: Sequence[LaneIndex], indicator: int) -> None:
        """Continue in other lanes, the first of them beside the present one."""
        self.indicator = indicator
        self.lanes[self.leg :] = lanes

    def act(self, action: object = None) -> None:
        """Decide: follow the lane, keep the gap, obey the script."""
        # enter the next lane of the chain where the present one ends
        lane = self.lanes[self.leg]
        s, r = self.road.lane_position(self, lane)
        if self.leg + 1 < len(self.lanes) and s > self.network.length(lane):
            self.leg += 1
            s, r = self.road.lane_position(self, self.lanes[self.leg])
        self.target_lane_index = self.lane_index = self.lanes[self.leg]
        # follow it, keep the gap, obey the rules, or the script
        wanted = self.forced_mps2
        if wanted is None:
            lead, gap = self.road.lead(self) or (None, math.inf)
            wanted = self.idm(lead, gap, self.allowed_mps(s))
            wanted = self.road.limit_by_rules(self, s, wanted)
        wanted = min(max(wanted, -self.behaviour.hardest_mps2), self.COMFORT_ACC_MAX)
        self.action = {"acceleration": wanted, "steering": self._steering(s, r)}
        self.braking = wanted < -0.7 or self.speed < 0.2

    def idm(self, leader: RoadObject | None, gap_m: float, allowed_mps: float) -> float:
        """Return IDM's acceleration (m/s2) for a leader at a gap between bumpers."""
        # highway-env's own `acceleration` subtracts coordinates of the present lane,
        # which means nothing around a corner
        allowed = max(min(allowed_mps, float(self.target_speed)), 0.01)
        free = self.COMFORT_ACC_MAX * (1 - (self.speed / allowed) ** self.DELTA)
        free = float(max(free, self.COMFORT_ACC_MIN))
        if leader is None:
            return free
        wanted = max(self.desired_gap(self, leader), self.DISTANCE_WANTED)
        return float(free - self.COMFORT_ACC_MAX * (wanted / max(gap_m, 0.3)) ** 2)

    def idm_stop(self, gap_m: float) -> float:
        """Return IDM's acceleration (m/s2) towards a line at which it must stop."""
        brake = 2 * math.sqrt(-self.COMFORT_ACC_MAX * self.COMFORT_ACC_MIN)
        wanted = 0.5 + self.speed * self.TIME_WANTED / 2 + self.speed**2 / brake
        return float(self.COMFORT_ACC_MAX * (1 - (wanted / max(gap_m, 0.3)) ** 2))

    def allowed_mps(self, lane_s: float) -> float:
        """Return the wanted speed, lowered for a limit or a curve here or ahead."""
        allowed, ahead = float(self.target_speed), -lane_s
        for index in self.lanes[self.leg :]:
            lane = self.network.lane(index)
            here = float(lane.speed_limit) if self.behaviour.obeys_limits else math.inf
            radius = getattr(lane, "radius", None)
            if radius is not None:
                here = min(here, math.sqrt(LATERAL_COMFORT_MPS2 * radius))
            reach = here * here + 2 * 2.0 * max(ahead, 0.0)
            allowed = min(allowed, math.sqrt(reach))
            ahead += float(lane.length)
            if ahead > LOOK_AHEAD_M / 2:
                break
        return allowed

    def step(self, dt: float) -> None:
        """Advance by ``dt`` seconds; never backwards."""
        slip = slip_of(self.action["steering"])
        before = float(self.speed)
        after = max(0.0, before + self.action["acceleration"] * dt)
        travel = (before + after) / 2 * dt
        turn = travel * math.sin(slip) / (self.LENGTH / 2)
        course = self.heading + slip + turn / 2
        self.position[0] += travel * math.cos(course)
        self.position[1] += travel * math.sin(course)
        self.heading += turn
        self.speed = after

    def _steering(self, s: float, r: float) -> float:
        """Return highway-env's `steering_control`, with an offset from the centre."""
        # The same cascade (lateral position, lateral speed, heading, heading rate,
        # slip) in plain floats, which is five times as fast
        lane, speed = self.network.lane(self.target_lane_index), max(self.speed, 0.01)
        future = float(lane.heading_at(s + self.speed * self.TAU_PURSUIT))
        sideways = -self.KP_LATERAL * (r + self.offset_m) / speed
        lean = math.asin(min(max(sideways, -1.0), 1.0))
        wanted = future + min(max(lean, -math.pi / 4), math.pi / 4)
        rate = self.KP_HEADING * math.remainder(wanted - self.heading, 2 * math.pi)
        slip = math.asin(min(max(self.LENGTH / 2 / speed * rate, -1.0), 1.0))
        wheel = math.atan(2 * math.tan(slip))
        most = float(self.MAX_STEERING_ANGLE)
        return min(max(wheel, -most), most)
