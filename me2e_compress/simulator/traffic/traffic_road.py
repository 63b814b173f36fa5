"""highway-env's road with one vectorised query a decision instead of n squared.

Lane changes: MOBIL as in highway-env, and joining from a lane that ends.

MOBIL (Kesting, Treiber and Helbing 2007) with highway-env's constants, but for the
politeness, which each driver has for itself.
"""

import math
from collections.abc import Sequence

import numpy as np
from highway_env.road.road import Road
from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.plane_geometry import Floats, overlaps
from me2e_compress.simulator.traffic.bodies import LOOK_AHEAD_M, Car, Walker
from me2e_compress.simulator.traffic.network import LaneIndex, LaneTable, Network
from me2e_compress.simulator.traffic.right_of_way import RightOfWay

EVERY = 10  # decisions between two looks: highway-env's LANE_CHANGE_DELAY is 1 s
# highway-env's LANE_CHANGE_MIN_ACC_GAIN and LANE_CHANGE_MAX_BRAKING_IMPOSED
MIN_GAIN_MPS2, MOST_IMPOSED_MPS2 = 0.2, 2.0
JOIN_IMPOSED_MPS2 = 3.5  # what somebody whose lane ends imposes on others: our choice
NEAREST_M = 2.0  # gap between bumpers below which nobody changes
# Nobody changes nearer than this to the beginning of a lane, or in a junction: who
# comes up behind is on another lane yet
SETTLED_M = 30.0
SLOWEST_MPS = 1.0
FORESEEN_S = (1.0, 2.0, 3.0)  # when drivers foresee people who cross, seconds from now
INSIDE_M, ALONG_RAD = 0.6, 0.3  # the ego nearer is wholly in a lane
Pair = tuple[RoadObject, RoadObject]
BESIDE_M = 0.25  # two bodies closer than this sideways are in each other's way


def _change_lane_if_better(car: Car, wanted_mps2: float) -> None:
    """Change to a lane beside if that is better, once a second."""
    if car.indicator and abs(car.road.lane_position(car, car.lanes[car.leg])[1]) < 0.4:
        car.indicator = 0
    car.until_change -= 1
    if car.until_change > 0 or car.speed < SLOWEST_MPS or car.indicator:
        return
    car.until_change = EVERY
    lane = car.lanes[car.leg][2]
    best, gained = None, MIN_GAIN_MPS2
    for side, other in ((1, lane - 1), (-1, lane + 1)):
        chain = _chain_beside(car, other)
        if (
            chain is None
            or (imposed := _braking_imposed(car, chain)) > MOST_IMPOSED_MPS2
        ):
            continue
        gain = _acceleration_on(car, chain) - wanted_mps2
        gain -= car.behaviour.politeness * max(imposed, 0.0)
        if gain > gained:
            best, gained = (chain, side), gain
    if best is not None:
        car.change_lane(*best)


def _chain_beside(car: Car, lane: int) -> list[LaneIndex] | None:
    """Return the rest of a car's chain in another lane; None if it is not all there."""
    graph, lanes = car.network.graph.graph, list[LaneIndex]()
    for a, b, _ in car.lanes[car.leg :]:
        if not 0 <= lane < len(graph[a][b]) or (a, b, lane) in car.network.closed:
            return None
        lanes.append((a, b, lane))
    return lanes


def _acceleration_on(car: Car, chain: list[LaneIndex]) -> float:
    """Return the acceleration that a car would have on a chain."""
    lead, gap = car.road.lead(car, chain) or (None, math.inf)
    if gap < NEAREST_M:
        return -math.inf
    return car.idm(lead, gap, float(car.target_speed))


def _braking_imposed(car: Car, chain: list[LaneIndex]) -> float:
    """Return the braking that a car imposes on who is behind it in another lane."""
    follower = car.road.follower(car, chain[0])
    if follower is None:
        return 0.0
    body, gap = follower
    if gap < NEAREST_M:
        return math.inf
    if isinstance(body, Car):
        return -float(body.idm(car, gap, float(body.target_speed)))
    # the ego, or who follows no lane: what braking avoids a contact
    closing: float = max(body.speed - car.speed, 0.0)
    return float(closing**2 / (2 * gap))


class TrafficRoad(Road):  # type: ignore[misc]  # highway-env is untyped
    """The road: who is in front of whom, and who touches whom."""

    # Connected lanes are searched for leaders, as highway-env's environments of version
    # 1 do. A crash is a real overlap of two rectangles: stock highway-env also calls a
    # predicted one a crash, and says neither who nor what was hit.

    def __init__(self, network: Network, rules: RightOfWay) -> None:
        super().__init__(network.graph, neighbour_vehicles_connected_lanes=True)
        self.table = LaneTable(network.graph)
        self._bodies = list[RoadObject]()
        self._row: dict[int, int] = {}
        self._s: Floats = np.zeros((0, 0))
        self._r: Floats = np.zeros((0, 0))
        self._half = list[float]()
        self._ego = list[bool]()
        self._lanes: dict[int, list[tuple[float, float, int]]] = {}
        self.rules = rules
        self.ego_s = 0.0

    def refresh(self) -> None:
        """Update the positions from which the queries below answer."""
        self._bodies = [*self.vehicles, *self.objects]
        self._lanes = {}
        points = np.array([body.position for body in self._bodies])
        # where people who cross will be, too: drivers stop for them in time
        crossers = [points]
        for walker in self.vehicles:
            if isinstance(walker, Walker) and walker.crosses and walker.speed > 0.3:
                for ahead_s in FORESEEN_S:
                    self._bodies.append(walker)
                    crossers.append((walker.position + walker.velocity * ahead_s)[None])
        points = np.concatenate(crossers)
        self._row = {id(body): i for i, body in enumerate(self.vehicles)}
        self._s, self._r = self.table.coordinates(points)
        self._half = [body.WIDTH / 2 for body in self._bodies]
        # what stands across a lane takes the width that it takes there
        first = len(self.vehicles)
        s, r = self._s[first:], np.abs(self._r[first:])
        along = self.table.headings(s)
        r = np.where((s < 0) | (s > self.table.length), np.inf, r)
        for row, body in enumerate(self.objects):
            askew = body.heading - along[row, int(np.argmin(r[row]))]
            cos, sin = abs(math.cos(askew)), abs(math.sin(askew))
            self._half[first + row] = float(body.WIDTH * cos + body.LENGTH * sin) / 2
        self._ego = [body.id == 0 for body in self._bodies]

    def lane_position(self, car: Car, index: LaneIndex) -> tuple[float, float]:
        """Return a car's arc length and right offset in a lane, at the last refresh."""
        row, column = self._row[id(car)], self.table.column[index]
        return float(self._s[row, column]), float(self._r[row, column])

    def lead(
        self, car: Car, chain: Sequence[LaneIndex] | None = None
    ) -> tuple[RoadObject, float] | None:
        """Return the next body in a car's way, and the gap between the bumpers (m).

        With a ``chain``, of which the first lane is beside the present one, as if the
        car were on it.
        """
        row, lanes = self._row[id(car)], chain or car.lanes[car.leg :]
        offset = -float(self._s[row, self.table.column[lanes[0]]])
        beside, blind = car.WIDTH / 2 + BESIDE_M, not car.behaviour.sees_ego
        for k, index in enumerate(lanes):
            # the first body in the way on this lane of the chain
            column = self.table.column[index]
            here = k == 0 and chain is None
            own = float(self._r[row, column]) if here else 0.0
            for s, r, other in self._on_lane(column):
                if other == row or s + offset <= 0:
                    continue
                if blind and self._ego[other]:
                    # the distance is kept to an ego well inside, in one's direction
                    turn = self.vehicles[0].heading - car.heading
                    along = abs(math.remainder(turn, math.tau)) < ALONG_RAD
                    if not (along and abs(r) < INSIDE_M):
                        continue
                room = self._half[other] + beside
                if abs(r + car.offset_m) < room or (here and abs(r - own) < room):
                    body = self._bodies[other]
                    return body, s + offset - (car.LENGTH + body.LENGTH) / 2
            # else look into the next lane
            offset += float(self.table.length[column])
            if offset > LOOK_AHEAD_M:
                break
        return None

    def _on_lane(self, column: int) -> list[tuple[float, float, int]]:
        """Return (arc length, right offset, row) of the bodies along a lane."""
        if column not in self._lanes:
            s, r = self._s[:, column], self._r[:, column]
            along = np.flatnonzero((s >= 0) & (s <= self.table.length[column]))
            columns = (s[along].tolist(), r[along].tolist(), along.tolist())
            rows = zip(*columns, strict=True)
            self._lanes[column] = sorted(rows, key=lambda row: row[0])
        return self._lanes[column]

    def follower(self, car: Car, index: LaneIndex) -> tuple[RoadObject, float] | None:
        """Return who is behind a car in another lane, and the gap (m)."""
        row, column = self._row[id(car)], self.table.column[index]
        at, last = float(self._s[row, column]), None
        blind = not car.behaviour.sees_ego
        for s, r, other in self._on_lane(column):
            if s >= at:
                break
            if blind and self._ego[other]:
                continue
            if other != row and abs(r) < self._half[other] + 1.0:
                last = s, other
        if last is None:
            return None
        body = self._bodies[last[1]]
        return body, at - last[0] - (car.LENGTH + body.LENGTH) / 2

    def limit_by_rules(self, car: Car, lane_s: float, wanted_mps2: float) -> float:
        """Limit the acceleration that a car wants by the rules; it may change lanes."""
        stop_m = self.rules.stop_m(car, lane_s)
        if stop_m < math.inf:
            wanted_mps2 = min(wanted_mps2, car.idm_stop(stop_m))
        if car.joins is not None and car.leg == len(car.lanes) - 1:
            # leave a lane that ends, if there is a gap in the other one
            chain = car.joins
            station = car.network.lane(chain[0]).local_coordinates(car.position)[0]
            lanes, _ = car.network.rest(chain, float(station))
            bearable = _braking_imposed(car, lanes) <= JOIN_IMPOSED_MPS2
            if bearable and _acceleration_on(car, lanes) >= -4.0:
                car.change_lane(lanes, 1)
                car.joins = None
                return wanted_mps2
            end = car.network.length(car.lanes[-1]) - car.LENGTH / 2 - 2.0
            return min(wanted_mps2, car.idm_stop(max(end - lane_s, 0.1)))
        begins = car.leg > 0 and lane_s < SETTLED_M
        if car.behaviour.changes_lanes and not begins:
            _change_lane_if_better(car, wanted_mps2)
        return wanted_mps2

    def act(self) -> None:
        """Let every car decide on the same positions."""
        self.refresh()
        cars = [body for body in self.vehicles if isinstance(body, Car)]
        self.rules.refresh(cars, self.vehicles[0], self.ego_s)
        super().act()

    def step(self, dt: float) -> None:
        """Move all vehicles; `touching` finds crashes."""
        for vehicle in self.vehicles:
            vehicle.step(dt)

    def touching(self) -> list[Pair]:
        """Return the pairs that overlap now and of which at least one moves."""
        bodies, pairs = [*self.vehicles, *self.objects], list[Pair]()
        # pairs close enough by their diagonals, then the exact test
        x, y = np.concatenate([body.position for body in bodies]).reshape(-1, 2).T
        reach = np.array([body.diagonal / 2 for body in bodies])
        dx, dy, room = x[:, None] - x, y[:, None] - y, reach[:, None] + reach
        for i, j in np.argwhere(dx * dx + dy * dy < room * room).tolist():
            one, other = bodies[i], bodies[j]
            if i >= j or (one.speed <= 0 and other.speed <= 0):
                continue
            # people step aside for each other, and round things
            people = [isinstance(body, Walker) for body in (one, other)]
            if all(people) or (any(people) and other in self.objects):
                continue
            if overlaps(np.array(one.box), np.array(other.box)):
                pairs.append((one, other))
        return pairs
