"""Sampled futures of the ego: accelerations times lateral targets."""

import math
from dataclasses import dataclass

import numpy as np

from me2e_compress.evaluators.highway.expert.forecast import TIMES_S, Flags
from me2e_compress.evaluators.highway.expert.lateral_targets import Options, Place
from me2e_compress.evaluators.highway.reentry import beyond, reentry
from me2e_compress.simulator.plane_geometry import Floats, RoutePath
from me2e_compress.simulator.scene import Ego
from me2e_compress.simulator.traffic.bodies import ACCELERATION_LAG_S

ACCELERATIONS_MPS2 = (-7.5, -5.5, -4.0, -2.8, -1.8, -1.0, -0.4, 0.0, 0.6, 1.2, 2.0)
STEPS = tuple(
    (step, math.exp(-step / ACCELERATION_LAG_S))
    for step in np.diff(TIMES_S, prepend=0.0).tolist()
)
"""Seconds of every step, and what is left of a missing acceleration after it."""
HARDEST_EASE_MPS2 = 3.0
"""Strongest braking for the speed ceiling."""
CHANGE_S = 2.6
"""Duration of a whole lane change; shorter shifts take less."""
SHORTEST_CHANGE_M = 9.0
FULL_CHANGE_M = 3.5


@dataclass(frozen=True, eq=False)
class SampledFutures:
    """K futures at the 18 times of `TIMES_S`; arrays are [K, T] or, from there on, [K].

    The heading is the body's: in a bend it differs from the direction of travel by the
    slip angle. ``lateral_m`` and ``target_m`` are metres left of the route,
    ``acceleration`` is the initial one, ``oncoming`` refers to the target's lane.
    """

    x: Floats
    y: Floats
    heading: Floats
    along_m: Floats
    lateral_m: Floats
    speed_mps: Floats
    acceleration: Floats
    target_m: Floats
    oncoming: Flags


def sample(
    path: RoutePath,
    top: Floats,
    ego: Ego,
    place: Place,
    options: Options,
    stop_m: float | None,
) -> SampledFutures:
    """Roll out every pair of acceleration and lateral target.

    ``top`` is the [N] speed ceiling along the route. ``stop_m`` is the arc length at
    which the ego's centre should stop, if any; it adds an acceleration that stops
    there.
    """
    # candidate accelerations, one of which stops at the line
    rates = list(ACCELERATIONS_MPS2)
    if stop_m is not None:
        room = max(stop_m - place.s_m, 0.05)
        rates.append(max(-(place.speed_mps**2) / (2 * room), -8.0))
    # every acceleration with every target
    along, speed = _speeds(top, place, np.array(rates))
    repeat, count = len(options.target_m), len(rates)
    along, speed = np.tile(along, (repeat, 1)), np.tile(speed, (repeat, 1))
    target = np.repeat(options.target_m, count)
    lateral = _laterals(place, along - place.s_m, target)
    x, y, heading = beyond(path, along, lateral)
    # body heading: course minus slip angle
    moved = np.diff(along, axis=1, prepend=place.s_m)
    shifted = np.diff(lateral, axis=1, prepend=place.lateral_m)
    slip = np.clip(path.value(path.curvature, along) * ego.length / 2, -0.5, 0.5)
    heading = heading + np.arctan2(shifted, np.maximum(moved, 0.3)) - np.arcsin(slip)
    return SampledFutures(
        *(x, y, heading, along, lateral, speed),
        acceleration=np.tile(np.array(rates), repeat),
        target_m=target,
        oncoming=np.repeat(options.oncoming, count),
    )


def _speeds(top: Floats, place: Place, rates: Floats) -> tuple[Floats, Floats]:
    """Return arc lengths and speeds, each [rates, T], with the actuators' lag."""
    along = np.full_like(rates, max(place.s_m, 0.0))
    speed = np.full_like(rates, place.speed_mps)
    alongs, speeds = [], []
    missing = place.acceleration_mps2 - rates
    for step, left in STEPS:
        mean = rates + missing * (1 - left) * ACCELERATION_LAG_S / step
        missing = missing * left
        limit = top[np.minimum(along.astype(np.int64), len(top) - 1)]
        allowed = np.maximum(limit, speed - HARDEST_EASE_MPS2 * step)
        after = np.minimum(np.maximum(speed + mean * step, 0.0), allowed)
        along = along + (speed + after) / 2 * step
        speed = after
        alongs.append(along)
        speeds.append(speed)
    return np.stack(alongs, axis=1), np.stack(speeds, axis=1)


def _laterals(place: Place, travel: Floats, target: Floats) -> Floats:
    """Return [K, T] offsets on the way to a lateral target."""
    share = np.sqrt(np.abs(target - place.lateral_m) / FULL_CHANGE_M)
    seconds = CHANGE_S * np.clip(share, 0.6, 1.2)
    length = np.maximum(
        place.speed_mps * seconds, SHORTEST_CHANGE_M * np.maximum(share, 0.6)
    )
    return reentry(travel, place.lateral_m, place.slope, target, length)
