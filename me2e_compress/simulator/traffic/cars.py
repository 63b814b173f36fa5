"""Cars that follow lanes by highway-env's IDM, each with its own behaviour.

What stock `IDMVehicle` gets wrong and this one does not (highway-env 1.12): its
parameters are class attributes that one environment changes under another; it reverses
when cut off; it draws random numbers where no route is given; it shares one route list
between cars; and it measures the gap in the coordinates of its own lane even where the
leader is around the corner.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass

from highway_env.vehicle.behavior import IDMVehicle
from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.bicycle import slip_of
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import DIMENSIONS, ActorKind
from me2e_compress.simulator.traffic.network import (
    LaneIndex,
    Network,
    Pose,
    flip,
)

LATERAL_COMFORT_MPS2 = 2.5
"""Lateral acceleration at which actors take a curve: our choice, half the comfort
bound of nuPlan (4.89)."""
LOOK_AHEAD_M = 70.0


@dataclass(frozen=True, slots=True)
class Behaviour:
    """IDM parameters of one car; defaults are highway-env's but for the gaps.

    highway-env's jam distance of 10 m is measured between centres; ours between
    bumpers.
    """

    acceleration_mps2: float = 3.0
    braking_mps2: float = 5.0
    hardest_mps2: float = 8.0
    jam_gap_m: float = 2.5
    headway_s: float = 1.2
    sees_ego: bool = True
    """False for actors that ignore the ego."""
    obeys_limits: bool = True
    """False for emergency vehicles."""
    obeys_rules: bool = True
    """False for those who pass red lights and priority traffic."""
    gap_s: float = 1.2
    """Time to spare before priority traffic."""
    changes_lanes: bool = False
    """Whether MOBIL decides, every second, if a lane beside is better."""
    politeness: float = 0.0
    """MOBIL's weight of what a lane change costs others; highway-env has 0."""


class Car(IDMVehicle):  # type: ignore[misc]  # highway-env is untyped
    """An actor on lanes.

    Args:
        id: Unique.
        network: Where it drives.
        lanes: The lanes it will take, each the successor of the one before.
        s_m: Arc length on the first of them at which it starts.
        speed_mps: Initial speed.
        target_mps: Wanted speed; the initial one by default.
        kind: Decides its size.
        behaviour: Its IDM parameters.
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
        super().__init__(
            None,
            flip(pose.x, pose.y),
            -pose.heading,
            speed_mps,
            enable_lane_change=False,
            timer=0.5,
        )
        self.id, self.kind, self.network = id, kind, network
        self.LENGTH, self.WIDTH, self.height = DIMENSIONS[kind]
        self.diagonal = math.hypot(self.LENGTH, self.WIDTH)
        self.speed: float = speed_mps
        self.position: Floats
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
        self.forced_mps2: float | None = None
        """An acceleration that a script imposes instead of IDM's."""
        self.offset_m = 0.0
        """How far left of the lane's centre it drives."""
        self.braking, self.indicator = False, 0
        self.until_change = id % 10
        """Decisions until it looks for a better lane."""
        self.joins: list[LaneIndex] | None = None
        """The chain that it joins where its own ends."""

    @property
    def pose(self) -> Pose:
        """Right-handed pose."""
        x, y = self.position
        return Pose(float(x), -float(y), -float(self.heading))

    @property
    def lane_s(self) -> float:
        """Arc length in the present lane."""
        lane = self.network.lane(self.lanes[self.leg])
        return float(lane.local_coordinates(self.position)[0])

    @property
    def station_m(self) -> float:
        """Metres from the beginning of its first lane."""
        done = sum(self.network.length(index) for index in self.lanes[: self.leg])
        return done + self.lane_s

    @property
    def gone(self) -> bool:
        """Whether it has left its last lane."""
        last = self.leg == len(self.lanes) - 1
        return last and self.lane_s > self.network.length(self.lanes[-1])

    def change_lane(self, lanes: Sequence[LaneIndex], indicator: int) -> None:
        """Continue in other lanes, the first of them beside the present one."""
        self.indicator = indicator
        self.lanes[self.leg :] = lanes

    def follow_road(self) -> tuple[float, float]:
        """Enter the next lane of the chain where the present one ends.

        Returns the arc length in the present lane, and the offset to its right.
        """
        s, r = self.road.seat(self, self.lanes[self.leg])
        length = self.network.length(self.lanes[self.leg])
        if self.leg + 1 < len(self.lanes) and s > length:
            self.leg += 1
            s, r = self.road.seat(self, self.lanes[self.leg])
        self.target_lane_index = self.lane_index = self.lanes[self.leg]
        return s, r

    def act(self, action: object = None) -> None:
        """Decide: follow the lane, keep the gap, obey the script."""
        s, r = self.follow_road()
        wanted = self.forced_mps2
        if wanted is None:
            lead, gap = self.road.lead(self) or (None, math.inf)
            wanted = self.idm(lead, gap, self.allowed_mps(s))
            wanted = self.road.ruled(self, s, wanted)
        wanted = min(max(wanted, -self.behaviour.hardest_mps2), self.COMFORT_ACC_MAX)
        self.action = {"acceleration": wanted, "steering": self._steering(s, r)}
        self.braking = wanted < -0.7 or self.speed < 0.2

    def idm(self, leader: RoadObject | None, gap_m: float, allowed_mps: float) -> float:
        """Return IDM's acceleration (m/s2) for a leader at a gap between bumpers.

        highway-env's own `acceleration`, but for the gap: that one subtracts
        coordinates of the present lane, which means nothing around a corner.
        """
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
        """Return highway-env's `steering_control`, with an offset from the centre.

        The same cascade (lateral position, lateral speed, heading, heading rate,
        slip) in plain floats, which is five times as fast.
        """
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
