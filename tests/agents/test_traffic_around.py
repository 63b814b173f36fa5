import math

import numpy as np
import pytest

from me2e_compress.agents.carla_interface import agents_around
from tests.agents.small_leaderboard import World


@pytest.mark.parametrize("yaw_deg", [0.0, 30.0, -135.0])
def test_places_are_told_in_the_ego_frame(yaw_deg: float) -> None:
    world = World(x=5.0, y=-3.0, yaw_deg=yaw_deg)
    yaw = math.radians(yaw_deg)
    forward = np.array([math.cos(yaw), math.sin(yaw)])
    right = np.array([-math.sin(yaw), math.cos(yaw)])
    world.put("vehicle.audi.tt", *(forward * 12 - right * 2 + (5.0, -3.0)))

    assert agents_around(world.hero) == pytest.approx(np.array([[12.0, 2.0]]))


def test_nobody_is_there() -> None:
    found = agents_around(World().hero)

    assert found is not None
    assert found.shape == (0, 2)
    assert agents_around(None) is None
