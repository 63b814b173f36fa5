"""Traffic lights and signs, when the ego disobeys them, and who may enter when."""

import math
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, field

import numpy as np

from me2e_compress.simulator.scene import EventKind, Signal, SignalKind, SignalState
from me2e_compress.simulator.traffic.bodies import Car, EgoVehicle
from me2e_compress.simulator.traffic.network import (
    LANE_WIDTH_M,
    LaneIndex,
    Network,
    Pose,
)

STOPPED_MPS = 0.1  # slower than this is stopped, as in CARLA's RunningStopTest
# Where a stop counts: metres from the front bumper to the line. CARLA looks for the
# stop within 4 m of the sign.
STOP_ZONE_M = (-1.0, 5.0)
YIELD_GAP_S = 1.5  # least time to a priority vehicle at the conflict
# Yellow is 3 s in CARLA (its traffic lights' default) and at 50 km/h in most countries;
# two seconds in which all have red clear a junction of 24 m at 12 m/s
YELLOW_S, ALL_RED_S = 3.0, 2.0
TOUCH_M = 2.6  # lanes closer than this are in conflict: a car and a margin
REACH_M = 70.0  # how far from a junction others are looked for; 5 s at 14 m/s
DECIDE_M = 30.0  # how far from a junction a driver decides whether to enter
START_MPS2 = 2.0  # acceleration with which a driver expects anybody to enter
YELLOW_MPS2 = 3.0  # a yellow light stops who can brake no harder than this
HARDEST_MPS2 = 6.0  # a red light stops who can brake no harder than this
LINE_M = 4.0  # where who waits without a line stops, metres before a junction
ENTRY_M = 4.0  # the ego enters all conflicts at once that begin this close to the first
RECKLESS = -1  # rank of those who obey nothing: everybody else lets them pass


@dataclass
class Regulator:
    """A light or sign at one stop line."""

    id: int
    kind: SignalKind
    line: Pose  # centre of the stop line, heading of the traffic that must obey
    line_s: float | None  # arc length (m) at which the ego's route crosses it, if so
    state: SignalState | None = None  # phase of a light
    width_m: float = LANE_WIDTH_M
    # Of a give-way sign: seconds until the next vehicle with priority reaches the
    # conflict, and the conflict's arc length (m) on the ego's route
    nearest_s: Callable[[], float] = field(default=lambda: math.inf, repr=False)
    conflict_s: float = math.inf
    _conflict_passed: bool = False
    _tail_passed: bool = False
    _stopped: bool = False

    def snapshot(self) -> Signal:
        """Return it as it is seen: the lamp is at the right end of the line."""
        left = self.line.moved(0.0, self.width_m / 2)
        right = self.line.moved(0.0, -self.width_m / 2)
        post = self.line.moved(0.5, -self.width_m / 2 - 0.8)
        ends = (left.x, left.y), (right.x, right.y)
        x, y, heading = post.x, post.y, post.heading
        return Signal(self.id, self.kind, x, y, heading, self.state, ends)

    def check(self, front_s: float, tail_s: float, speed: float) -> EventKind | None:
        """Return which rule, each once, the ego breaks now between two arc lengths."""
        # Give way: the front may not enter the conflict just before who has priority
        if front_s >= self.conflict_s and not self._conflict_passed:
            self._conflict_passed = True
            if self.nearest_s() < YIELD_GAP_S:
                return EventKind.GIVE_WAY
        if self.line_s is None or self._tail_passed:
            return None
        # what the ego does at the line
        low, high = STOP_ZONE_M
        if low <= self.line_s - front_s <= high and speed < STOPPED_MPS:
            self._stopped = True
        if tail_s < self.line_s:
            return None
        # Red is run by the tail, as in CARLA, which also blames a car that entered too
        # late on yellow
        self._tail_passed = True
        if self.kind is SignalKind.STOP_SIGN and not self._stopped:
            return EventKind.STOP_SIGN
        if self.state is SignalState.RED:
            return EventKind.RED_LIGHT
        return None


@dataclass(frozen=True)
class SignalPlan:
    """Phases of two groups of lights in turn, from the clock alone.

    Each group is green for its time, yellow for `YELLOW_S`, then all are red for
    `ALL_RED_S`; nobody's standing changes them. ``offset_s`` is where in its cycle the
    plan is as the route begins.
    """

    groups: tuple[Sequence[Regulator], Sequence[Regulator]]
    green_s: tuple[float, float]
    offset_s: float

    @property
    def cycle_s(self) -> float:
        """Seconds after which it repeats."""
        return sum(self.green_s) + 2 * (YELLOW_S + ALL_RED_S)

    def begins_s(self, group: int) -> float:
        """Return when a group turns green for the first time, 0 s or later."""
        start = group * (self.green_s[0] + YELLOW_S + ALL_RED_S)
        return (start - self.offset_s) % self.cycle_s

    def state(self, group: int, time_us: int) -> SignalState:
        """Return the phase of a group."""
        cycle_us = round(self.cycle_s * 1e6)
        since_us = (time_us - round(self.begins_s(group) * 1e6)) % cycle_us
        green_us = round(self.green_s[group] * 1e6)
        if since_us < green_us:
            return SignalState.GREEN
        yellow = since_us < green_us + round(YELLOW_S * 1e6)
        return SignalState.YELLOW if yellow else SignalState.RED

    def show(self, time_us: int) -> None:
        """Set every light."""
        for number, group in enumerate(self.groups):
            state = self.state(number, time_us)
            for light in group:
                light.state = state


# Who may enter a junction. highway-env's own rule (`RegulatedRoad`) copies the whole
# road to look ahead, and knows no lights. Here conflicts of lanes are found once, from
# their centre lines, and drivers accept a gap if the times at which both would be in
# the conflict do not overlap.


@dataclass(frozen=True)
class Conflict:
    """Where a lane inside a junction is shared with another: arc lengths on both."""

    other: LaneIndex
    mine: tuple[float, float]
    theirs: tuple[float, float]


@dataclass(frozen=True)
class User:
    """A body that is on a lane inside a junction or will be."""

    id: int
    at_m: float  # arc length of its centre on that lane; negative before it
    speed_mps: float
    length_m: float
    rank: int
    bound: bool  # whether a red light holds it back

    @property
    def ends_m(self) -> tuple[float, float]:
        """Where its front and its rear are."""
        return self.at_m + self.length_m / 2, self.at_m - self.length_m / 2


class RightOfWay:
    """Rules of all junctions of a finished network.

    ``lines`` are stop lines with lights, by lane: arc length and light; ``ego_lanes``
    are those inside junctions on the ego's route, and where each begins.
    """

    def __init__(
        self,
        network: Network,
        lines: dict[LaneIndex, list[tuple[float, Regulator]]],
        ego_lanes: Sequence[tuple[LaneIndex, float]],
    ) -> None:
        self.network, self.lines, self.ego_lanes = network, lines, ego_lanes
        self.conflicts = conflicts_of(network)
        self._users: dict[LaneIndex, list[User]] = {}

    def refresh(self, cars: Iterable[Car], ego: EgoVehicle, ego_s_m: float) -> None:
        """Note who is where, before drivers decide."""
        self._users = {}
        for lane, begin in self.ego_lanes:
            at = ego_s_m - begin
            if -REACH_M < at < self.network.length(lane) + 10.0:
                rank, speed = self.network.ranks[lane], float(ego.speed)
                user = User(0, at, speed, ego.LENGTH, rank, False)
                self._users.setdefault(lane, []).append(user)
        for car in cars:
            self._note_car(car)

    def _note_car(self, car: Car) -> None:
        start = -car.road.lane_position(car, car.lanes[car.leg])[0]
        reckless, bound = not car.behaviour.obeys_rules, False
        for index in car.lanes[car.leg :]:
            if start > REACH_M:
                break
            if index in self.network.ranks:
                rank = RECKLESS if reckless else self.network.ranks[index]
                speed = float(car.speed)
                user = User(car.id, -start, speed, car.LENGTH, rank, bound)
                self._users.setdefault(index, []).append(user)
            elif index in self.lines and not reckless:
                bound |= any(
                    start + s > 0 and light.state is SignalState.RED
                    for s, light in self.lines[index]
                )
            start += self.network.length(index)

    def stop_m(self, car: Car, lane_s: float) -> float:
        """Return the metres from a car's front to where it must stop, else infinity."""
        if not car.behaviour.obeys_rules:
            return math.inf
        front = -lane_s - car.LENGTH / 2
        for index in car.lanes[car.leg :]:
            if front > DECIDE_M:
                break
            # lights on this lane
            for s, light in self.lines.get(index, ()):
                gap = front + s
                if gap > -0.5 and _stops(light, max(gap, 0.1), float(car.speed)):
                    return max(gap, 0.1)
            # a junction that begins here
            if index in self.network.ranks and front > 0.0:
                line = max(front - LINE_M, 0.1)
                hard = car.speed**2 / (2 * line) > HARDEST_MPS2
                if not hard and self._must_wait(car, index, front):
                    return line
            front += self.network.length(index)
        return math.inf

    def _must_wait(self, car: Car, lane: LaneIndex, front_m: float) -> bool:
        """Return whether somebody with priority, or inside, meets the car."""
        speed, rank = float(car.speed), self.network.ranks[lane]
        for conflict in self.conflicts.get(lane, ()):
            users = self._users.get(conflict.other)
            if not users:
                continue
            enters = _seconds(front_m + conflict.mine[0], speed)
            leaves = _seconds(front_m + conflict.mine[1] + car.LENGTH, speed)
            for user in users:
                if user.id == car.id:
                    continue
                # who has passed, or is held back, does not count
                nose, tail = user.ends_m
                if tail > conflict.theirs[1] or (user.bound and nose < 0.0):
                    continue
                # nor who waits outside and has no priority: rank, distance, then id
                mine = (rank, round(front_m), car.id)
                theirs = (user.rank, round(-nose), user.id)
                if nose < 0.0 and theirs > mine:
                    continue
                # wait for who is in the conflict, or would be there at the same time
                if nose > conflict.theirs[0]:
                    return True
                comes = _seconds(conflict.theirs[0] - nose, user.speed_mps)
                goes = _seconds(conflict.theirs[1] - tail, user.speed_mps)
                spare = car.behaviour.gap_s
                if enters < goes + spare / 2 and comes < leaves + spare:
                    return True
        return False

    def priority_over_ego(self) -> list[tuple[float, Conflict]]:
        """Return conflicts where others go before the ego, and where on its route."""
        ranks = self.network.ranks
        return [
            (begin + conflict.mine[0], conflict)
            for lane, begin in self.ego_lanes
            for conflict in self.conflicts.get(lane, ())
            if ranks[conflict.other] < ranks[lane]
        ]

    def soonest_s(self) -> float:
        """Return the seconds until somebody with priority is where the ego enters."""
        # Who is there already is before the ego, and leaves. Lanes that the ego crosses
        # later do not count.
        soonest, meets = math.inf, self.priority_over_ego()
        first = min((at for at, _ in meets), default=0.0)
        for at, conflict in meets:
            if at > first + ENTRY_M:
                continue
            for user in self._users.get(conflict.other, ()):
                nose, tail = user.ends_m
                if user.id == 0 or tail > conflict.theirs[0]:
                    continue
                gap_m = max(conflict.theirs[0] - nose, 0.0)
                soonest = min(soonest, gap_m / max(user.speed_mps, 1.0))
        return soonest


def conflicts_of(network: Network) -> dict[LaneIndex, list[Conflict]]:
    """Find the pairs of lanes inside junctions that share ground."""
    # Lanes that leave one place, or follow each other, are no conflict: there drivers
    # keep their distance
    conflicts: dict[LaneIndex, list[Conflict]] = {}
    for a in network.ranks:
        mine = network.centre(a)
        for b in network.ranks:
            if a[0] == b[0] or a[1] == b[0] or b[1] == a[0]:
                continue
            theirs = network.centre(b)
            close = np.hypot(*(mine[:, None] - theirs).transpose(2, 0, 1)) < TOUCH_M
            if not close.any():
                continue
            spans = []
            for lane, touched in ((a, close.any(axis=1)), (b, close.any(axis=0))):
                share = network.length(lane) / (len(touched) - 1)
                at = np.flatnonzero(touched)
                spans.append((float(at[0]) * share, float(at[-1]) * share))
            conflicts.setdefault(a, []).append(Conflict(b, *spans))
    return conflicts


def _stops(light: Regulator, gap_m: float, speed: float) -> bool:
    braking = speed**2 / (2 * gap_m)
    if light.state is SignalState.YELLOW:
        return braking < YELLOW_MPS2
    return light.state is SignalState.RED and braking < HARDEST_MPS2 + 2.0


def _seconds(distance_m: float, speed: float) -> float:
    """Return the time for a distance, accelerating gently from a speed to 8 m/s."""
    if distance_m <= 0.0:
        return 0.0
    top = max(speed, 8.0)
    ramp_m = (top * top - speed * speed) / (2 * START_MPS2)
    if ramp_m >= distance_m:
        reached = math.sqrt(speed * speed + 2 * START_MPS2 * distance_m)
        return (reached - speed) / START_MPS2
    return (top - speed) / START_MPS2 + (distance_m - ramp_m) / top
