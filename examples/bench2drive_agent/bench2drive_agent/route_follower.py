"""GPS to metres; the next node of a route, as Bench2Drive's agents find it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass, replace
from typing import Any, Self, TypeAlias

import numpy as np

EARTH_M = 6378137.0
"""Equatorial radius in CARLA's GeoLocation.cpp; its maps are Mercator's."""
PASSED_M, AHEAD_M = 4.0, 50.0
"""How near a node counts as reached, and how far along the route one is looked for:
Bench2DriveZoo, RoutePlanner(4.0, 50.0)."""
LANE_FOLLOW = 4
"""CARLA's RoadOption; what those agents make of VOID (-1)."""

Node: TypeAlias = tuple[np.ndarray, int]


@dataclass(frozen=True)
class GeoReference:
    """The geographic origin of a CARLA map in degrees.

    Mirrored readings fall to the north: those of CARLA 0.9.16 do.
    """

    latitude: float
    longitude: float
    mirrored: bool = False

    def as_read(self, reading: tuple[float, float], x: float, y: float) -> Self:
        """Return it mirrored if only then a reading is within 4 m of its place."""
        for each in (self, replace(self, mirrored=True)):
            if math.dist(each.metres(*reading), (x, y)) <= PASSED_M:
                return each
        return self

    @classmethod
    def through(cls, latitude: float, longitude: float, x: float, y: float) -> Self:
        """Find the origin from a place in degrees and in metres (x east, y north)."""
        origin = latitude
        for _ in range(8):  # places in a town take three
            north = _mercator(latitude) - y / _scale(origin)
            origin = math.degrees(2 * math.atan(math.exp(north))) - 90
        return cls(origin, longitude - math.degrees(x / _scale(origin)))

    def metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Convert a place to metres east and north of the map's origin."""
        north = _mercator(latitude) - _mercator(self.latitude)
        east = math.radians(longitude - self.longitude)
        scale = _scale(self.latitude)
        return scale * east, -scale * north if self.mirrored else scale * north


def _mercator(latitude: float) -> float:
    return math.log(math.tan(math.radians(90 + latitude) / 2))


def _scale(latitude: float) -> float:
    return EARTH_M * math.cos(math.radians(latitude))


class RouteFollower:
    """Steps along the nodes of a route (x east, y north, RoadOption), never back."""

    def __init__(self, nodes: Iterable[tuple[float, float, Any]]) -> None:
        table = list(nodes)
        self._places = np.array([node[:2] for node in table], np.float64)
        self._options = [node[2] for node in table]
        self._at = 0

    def next(self, x: float, y: float) -> Node:
        """Return the next two nodes, [2, 2] x east, y north, and the first's command.

        The farthest node within 4 m of the ego and 50 m of route is reached; the last
        node is never passed.
        """
        places = self._places[self._at :]
        steps = np.hypot(*np.diff(places, axis=0).T)
        begins = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
        away = np.hypot(*(places[1:] - (x, y)).T)
        reached = (away <= PASSED_M) & (begins[: len(away)] <= AHEAD_M)
        if reached.any():
            farthest = int(np.argmax(np.where(reached, away, -1.0))) + 1
            self._at += min(farthest, max(0, len(places) - 2))
        last = len(self._places) - 1
        near, far = min(self._at + 1, last), min(self._at + 2, last)
        return self._places[[near, far]], command_of(self._options[near])


def command_of(option: Any) -> int:
    """Return the command 0 to 5 of a RoadOption: 1 to 6, or -1 for none."""
    value = int(getattr(option, "value", option))
    return (LANE_FOLLOW if value < 0 else value) - 1
