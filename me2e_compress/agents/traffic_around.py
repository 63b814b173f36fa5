"""Where other road users are: what a latency that depends on the scene is told."""

import math
from typing import Any

import numpy as np
import numpy.typing as npt

KINDS = ("vehicle.", "walker.pedestrian.")
"""Beginnings of CARLA's type ids."""


def agents_around(hero: Any) -> npt.NDArray[np.float64] | None:
    """Return [N, 2], where other road users are, whatever hides them.

    Args:
        hero: The ego's ``carla.Actor``; None where the leaderboard does not give it.

    Returns:
        Metres in the ego frame, x forward, y left; None without a hero.
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
