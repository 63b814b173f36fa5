"""highway-env's road with one vectorised query a decision instead of n squared."""

import math

import numpy as np
import numpy.typing as npt
from highway_env.road.road import Road
from highway_env.vehicle.objects import RoadObject

from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.traffic.cars import LOOK_AHEAD_M, Car
from me2e_compress.simulator.traffic.lanes import LaneTable
from me2e_compress.simulator.traffic.network import LaneIndex, Network

BESIDE_M = 0.25
"""Two bodies closer than this sideways are in each other's way."""


class TrafficRoad(Road):  # type: ignore[misc]  # highway-env is untyped
    """The road: who is in front of whom, and who touches whom.

    Connected lanes are searched for leaders, as highway-env's environments of version 1
    do. A crash is a real overlap of two rectangles: stock highway-env also calls a
    predicted one a crash, and says neither who nor what was hit.
    """

    def __init__(self, network: Network) -> None:
        super().__init__(network.graph, neighbour_vehicles_connected_lanes=True)
        self.table = LaneTable(network.graph)
        self._bodies = list[RoadObject]()
        self._row: dict[int, int] = {}
        self._s: Floats = np.zeros((0, 0))
        self._r: Floats = np.zeros((0, 0))
        self._half: Floats = np.zeros(0)
        self._ego: npt.NDArray[np.bool_] = np.zeros(0, bool)

    def refresh(self) -> None:
        """Update the positions from which the queries below answer."""
        self._bodies = [*self.vehicles, *self.objects]
        self._row = {id(body): i for i, body in enumerate(self._bodies)}
        points = np.array([body.position for body in self._bodies])
        self._s, self._r = self.table.coordinates(points)
        self._half = np.array([body.WIDTH / 2 for body in self._bodies])
        self._ego = np.array([body.id == 0 for body in self._bodies])

    def seat(self, car: Car, index: LaneIndex) -> tuple[float, float]:
        """Return a car's arc length and right offset in a lane, at the last refresh."""
        row, column = self._row[id(car)], self.table.column[index]
        return float(self._s[row, column]), float(self._r[row, column])

    def lead(self, car: Car) -> tuple[RoadObject, float] | None:
        """Return the next body in a car's way, and the gap between the bumpers (m)."""
        row = self._row[id(car)]
        offset = -self._s[row, self.table.column[car.lanes[car.leg]]]
        for k, index in enumerate(car.lanes[car.leg :]):
            # bodies in the way on this lane of the chain
            column = self.table.column[index]
            s, r = self._s[:, column], self._r[:, column]
            room = self._half + (car.WIDTH / 2 + BESIDE_M)
            blocking = np.abs(r + car.offset_m) < room
            if k == 0:
                blocking |= np.abs(r - r[row]) < room
            blocking &= (s >= 0) & (s <= self.table.length[column]) & (s + offset > 0)
            blocking[row] = False
            if not car.behaviour.sees_ego:
                blocking &= ~self._ego
            # the nearest of them, else look into the next lane
            if blocking.any():
                ahead = np.where(blocking, s, np.inf)
                nearest = int(np.argmin(ahead))
                body = self._bodies[nearest]
                centres = float(ahead[nearest] + offset)
                return body, centres - (car.LENGTH + body.LENGTH) / 2
            offset += self.table.length[column]
            if offset > LOOK_AHEAD_M:
                break
        return None

    def act(self) -> None:
        """Let every car decide on the same positions."""
        self.refresh()
        super().act()

    def step(self, dt: float) -> None:
        """Move all vehicles; `touching` finds crashes."""
        for vehicle in self.vehicles:
            vehicle.step(dt)

    def touching(self) -> list[tuple[RoadObject, RoadObject]]:
        """Return the pairs that overlap now and of which at least one moves."""
        bodies = [*self.vehicles, *self.objects]
        if not any(body.speed > 0 for body in self.vehicles):
            return []
        points = np.array([body.position for body in bodies])
        reach = np.array([body.diagonal / 2 for body in bodies])
        moves = np.array([body.speed > 0 for body in bodies])
        delta = points[:, None] - points[None]
        room = reach[:, None] + reach[None]
        # pairs close enough by their diagonals, then the exact test
        near = (delta * delta).sum(axis=2) < room * room
        near &= moves[:, None] | moves[None]
        pairs = list[tuple[RoadObject, RoadObject]]()
        first, second = (side.tolist() for side in np.nonzero(np.triu(near, 1)))
        for i, j in zip(first, second, strict=True):
            if overlap(bodies[i], bodies[j]):
                pairs.append((bodies[i], bodies[j]))
        return pairs


def overlap(a: RoadObject, b: RoadObject) -> bool:
    """Return whether two rectangles overlap (separating axes)."""
    dx = float(b.position[0] - a.position[0])
    dy = float(b.position[1] - a.position[1])
    turn = float(b.heading - a.heading)
    c, s = abs(math.cos(turn)), abs(math.sin(turn))
    for one, other in ((a, b), (b, a)):
        ch, sh = math.cos(one.heading), math.sin(one.heading)
        along, across = abs(dx * ch + dy * sh), abs(dy * ch - dx * sh)
        if along > (one.LENGTH + other.LENGTH * c + other.WIDTH * s) / 2:
            return False
        if across > (one.WIDTH + other.LENGTH * s + other.WIDTH * c) / 2:
            return False
    return True
