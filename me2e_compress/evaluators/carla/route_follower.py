"""GPS to metres; the next node of a route, as Bench2Drive's agents find it."""

import math
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Self

import numpy as np
import numpy.typing as npt

EARTH_M = 6378137.0
"""Equatorial radius in CARLA's GeoLocation.cpp."""
STEPS = 8
"""Iterations of Newton's method; places in a town take three."""


@dataclass(frozen=True, slots=True)
class GeoReference:
    """The geographic origin of a CARLA map in degrees; maps are Mercator's."""

    latitude: float
    longitude: float

    @classmethod
    def through(cls, latitude: float, longitude: float, x: float, y: float) -> Self:
        """Find the origin from a place in degrees and in metres (x east, y north).

        A leaderboard gives the route in both forms, but not the origin.
        """
        place, origin = math.radians(latitude), math.radians(latitude)
        for _ in range(STEPS):
            away = _mercator(place) - _mercator(origin)
            miss = math.cos(origin) * away - y / EARTH_M
            origin -= miss / (-math.sin(origin) * away - 1.0)
        west = math.degrees(x / (EARTH_M * math.cos(origin)))
        return cls(math.degrees(origin), longitude - west)

    def metres(self, latitude: float, longitude: float) -> tuple[float, float]:
        """Convert a place to metres east and north of the map's origin."""
        origin = math.radians(self.latitude)
        scale = EARTH_M * math.cos(origin)
        north = _mercator(math.radians(latitude)) - _mercator(origin)
        return scale * math.radians(longitude - self.longitude), scale * north


def _mercator(latitude: float) -> float:
    return math.log(math.tan(math.pi / 4 + latitude / 2))


PASSED_M = 4.0
AHEAD_M = 50.0
"""How near a node counts as reached, and how far along the route one is looked for:
Bench2DriveZoo, RoutePlanner(4.0, 50.0)."""

LANE_FOLLOW = 4
"""CARLA's RoadOption; what those agents make of VOID (-1)."""

Node = tuple[npt.NDArray[np.float64], int]


class RouteFollower:
    """Steps along the nodes of a route, never back.

    ``nodes`` are (x east, y north, CARLA's RoadOption), at least one.
    """

    def __init__(self, nodes: Iterable[tuple[float, float, int]]) -> None:
        table = list(nodes)
        self._places = np.array([node[:2] for node in table], np.float64)
        self._options = [node[2] for node in table]
        self._at = 0

    def next(self, x: float, y: float) -> Node:
        """Return the node after the last one reached, and its command.

        The farthest node within 4 m of the ego and 50 m of route is reached; the last
        node is never passed. The ego is at ``x`` metres east, ``y`` north; the result
        is (float64 [2] x east, y north; command 0 to 5, as `Observation` numbers it).
        """
        # nodes ahead, with their distance along the route
        places = self._places[self._at :]
        steps = np.hypot(*np.diff(places, axis=0).T)
        begins = np.concatenate([[0.0], np.cumsum(steps)[:-1]])
        away = np.hypot(*(places[1:] - (x, y)).T)
        # step to the farthest node that is reached, never to the last one
        reached = (away <= PASSED_M) & (begins[: len(away)] <= AHEAD_M)
        if reached.any():
            farthest = int(np.argmax(np.where(reached, away, -1.0))) + 1
            self._at += min(farthest, max(0, len(places) - 2))
        index = min(self._at + 1, len(self._places) - 1)
        return self._places[index], command_of(self._options[index])

    @property
    def after_next(self) -> npt.NDArray[np.float64]:
        """The node after the latest result of `next`, float64 [2]."""
        after: npt.NDArray[np.float64] = self._places[self._at :][:3][-1]
        return after


def command_of(option: Any) -> int:
    """Return the command 0 to 5 of a RoadOption: 1 to 6, or -1 for none."""
    value = int(getattr(option, "value", option))
    return (LANE_FOLLOW if value < 0 else value) - 1
