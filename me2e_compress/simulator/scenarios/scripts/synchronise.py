"""Timing of scripts: meeting points, and what waits for the ego."""

from collections.abc import Sequence

import numpy as np

from me2e_compress.simulator.scenarios.layouts.road import BEFORE_M
from me2e_compress.simulator.scenarios.scripts.streams import near
from me2e_compress.simulator.traffic.bodies import Walker
from me2e_compress.simulator.traffic.cars import Car
from me2e_compress.simulator.traffic.network import LaneIndex
from me2e_compress.simulator.traffic.stage import Script, Stage

NEAR_M = 30.0
"""A standing obstacle counts as met when the ego is this close."""
TOUCH_M = 1.0


def meeting(stage: Stage, chain: Sequence[LaneIndex]) -> float:
    """Find where a chain of lanes meets the ego's route.

    Returns the arc length on the route of the first crossing, or of the place where the
    one joins the other.
    """
    points = np.concatenate([stage.network.centre(index) for index in chain])
    route = stage.path.points
    away = np.hypot(
        route[:, None, 0] - points[None, :, 0], route[:, None, 1] - points[None, :, 1]
    )
    nearest = away.min(axis=1)
    touching = np.flatnonzero(nearest < TOUCH_M)
    i = int(touching[0]) if len(touching) else int(np.argmin(nearest))
    for _ in range(2):
        i += int(i + 1 < len(nearest) and nearest[i + 1] < nearest[i])
    return float(i)


def steps_out(stage: Stage, walker: Walker, route_s: float) -> Script:
    """Start a walker, who crosses the route at ``route_s``, once the ego is near."""
    walker.crosses = True
    yield from near(stage, route_s)
    walker.going = True


def met(stage: Stage, route_s: float, name: str) -> Script:
    """Note that the ego has come near a standing obstacle."""
    while stage.ahead_m(route_s) > NEAR_M:
        yield
    stage.fire(name)


def hold(stage: Stage, seconds: float) -> Script:
    """Wait for some seconds."""
    end = stage.time_s + seconds
    while stage.time_s < end:
        yield


def stand(car: Car) -> None:
    """Keep a car where it is."""
    car.forced_mps2 = -4.0


def release(car: Car, target_mps: float) -> None:
    """Let a car drive by IDM."""
    car.forced_mps2, car.target_speed = None, target_mps


def keep_clear(stage: Stage, chain: Sequence[LaneIndex], until_s: float) -> None:
    """Let no traffic begin on a lane between the ego and a place of its route."""
    stage.clear[chain[0]] = (BEFORE_M - 8.0, BEFORE_M + until_s + 30.0)
