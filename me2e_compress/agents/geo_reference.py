"""GPS to metres: the origin of CARLA's projection, found from one known place."""

import math
from dataclasses import dataclass
from typing import Self

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
