"""The next node of a route and its command, as Bench2Drive's agents find them."""

from collections.abc import Iterable
from typing import Any

import numpy as np
import numpy.typing as npt

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
