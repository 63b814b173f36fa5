"""Sparse nodes of a route, for models that aim at a target point."""

import itertools
import math
from dataclasses import dataclass
from typing import Self

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.scene import Ego, RoutePath

APART_M = 50.0
REACHED_M = 4.0
"""The most metres of route between two nodes, and how near one counts as reached:
Bench2Drive's leaderboard thins the plan to 50 m, its agents' RoutePlanner(4.0, 50.0)
takes nodes off at 4 m."""


@dataclass(frozen=True, eq=False, slots=True)
class RouteNodes:
    """Nodes where the command changes, every 50 m between them, and at the end.

    ``stations_m`` are ascending arc lengths, ``points`` are [N, 2] (x east, y north).
    """

    stations_m: npt.NDArray[np.float64]
    points: npt.NDArray[np.float64]

    @classmethod
    def along(cls, path: RoutePath) -> Self:
        """Place the nodes of a route."""
        changes = 1 + np.flatnonzero(np.diff(path.commands))
        kept = [0, *changes.tolist(), len(path.points) - 1]
        places: list[int] = []
        for begin, end in itertools.pairwise(kept):
            parts = max(1, math.ceil((end - begin) / APART_M))
            places += [begin + (end - begin) * part // parts for part in range(parts)]
        places = sorted({*places, kept[-1]})
        return cls(np.array(places, float), np.asarray(path.points[places], float))

    def ahead(self, station_m: float, ego: Ego) -> npt.NDArray[np.float32]:
        """Return [2, 2] the next two nodes from an arc length, in the ego frame."""
        last = len(self.points) - 1
        index = int(np.searchsorted(self.stations_m, station_m + REACHED_M, "right"))
        found = self.points[[min(index, last), min(index + 1, last)]]
        cos, sin = math.cos(ego.heading), math.sin(ego.heading)
        turned = (found - (ego.x, ego.y)) @ np.array([[cos, -sin], [sin, cos]])
        return np.asarray(turned, np.float32)
