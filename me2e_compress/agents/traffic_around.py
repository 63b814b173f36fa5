"""Positions of other road users, for latency sources that depend on the scene."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

KINDS = ("vehicle.", "walker.pedestrian.")
"""Beginnings of CARLA's type ids."""


def agents_around(hero: Any) -> npt.NDArray[np.float64] | None:
    """Return positions [N, 2] of other road users, occluded or not.

    Metres in the ego frame, x forward, y left; None without ``hero``, the ego's
    ``carla.Actor``, which not every leaderboard gives.
    """
    if hero is None:
        return None
    at = hero.get_transform()
    yaw = math.radians(at.rotation.yaw)
    others = (
        each.get_location()
        for each in hero.get_world().get_actors()
        if each.type_id.startswith(KINDS) and each.id != hero.id
    )
    away = [(place.x - at.location.x, place.y - at.location.y) for place in others]
    # CARLA's y points to the right, and so does its yaw
    turn = [[math.cos(yaw), math.sin(yaw)], [math.sin(yaw), -math.cos(yaw)]]
    return np.array(away, np.float64).reshape(-1, 2) @ turn
