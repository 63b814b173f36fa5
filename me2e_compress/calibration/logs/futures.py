"""Ground truth of a frame, from the moments after it."""

import math
from collections.abc import Sequence

import numpy as np

from me2e_compress.calibration.logs.base import (
    Agent,
    DriveLog,
    Floats,
    LogMoment,
    LogScene,
    heading_of,
)
from me2e_compress.runtime.recorded_future import (
    STEP_S,
    STEPS,
    Box,
    Point,
    RecordedFuture,
)

TOLERANCE_S = 0.25
"""Largest difference, half a step, between a moment's time and that of its step."""


def recorded_future(
    log: DriveLog, scene: LogScene, at: int, lidar_to_ground: Floats
) -> RecordedFuture:
    """Return the recorded three seconds after moment ``at`` of a scene.

    ``lidar_to_ground`` [4, 4] leads to the ground frame of the model's plan.
    """
    now = scene[at]
    later = [_later(scene, at, step, log.half_second) for step in range(1, STEPS + 1)]
    # Poses are relative to the ground frame at this moment.
    from_world = lidar_to_ground @ np.linalg.inv(now.lidar_to_world)
    back = np.linalg.inv(lidar_to_ground)
    waypoints = [
        None if each is None else _place(from_world @ each.lidar_to_world @ back)
        for each in later
    ]
    return RecordedFuture(
        waypoints=tuple(waypoints),
        forward=heading_of(lidar_to_ground),
        ego=log.ego_size,
        centre=_place(lidar_to_ground @ np.linalg.inv(now.lidar_to_ego)),
        agents=_agents(later, from_world),
        command=command_at(log, scene, at),
    )


def command_at(log: DriveLog, scene: LogScene, at: int) -> int:
    """Return the recorded command, or one derived from the vehicle's later path.

    As in UniAD and VAD, that depends on how far to the right of the lidar the vehicle
    is at the last known moment of the next three seconds.
    """
    now = scene[at]
    if now.command is not None:
        return now.command
    # Take the last known moment of the next three seconds.
    later = [_later(scene, at, step, log.half_second) for step in range(1, STEPS + 1)]
    last = next((each for each in reversed(later) if each is not None), now)
    right, _ = _place(np.linalg.inv(now.lidar_to_world) @ last.lidar_to_world)
    return log.command_of(right)


def _later(scene: LogScene, at: int, step: int, half_second: int) -> LogMoment | None:
    """Return the moment ``step`` half seconds later; None where the log has none."""
    index = at + step * half_second
    if index >= len(scene):
        return None
    found = scene[index]
    passed_s = (found.time_us - scene[at].time_us) / 1e6
    return found if abs(passed_s - step * STEP_S) <= TOLERANCE_S else None


def _place(to_ground: Floats) -> Point:
    return float(to_ground[0, 3]), float(to_ground[1, 3])


def _agents(
    later: Sequence[LogMoment | None], from_world: Floats
) -> tuple[tuple[Box, ...], ...] | None:
    known = [each.agents for each in later if each is not None]
    if not known or None in known:
        return None
    turn = math.atan2(from_world[1, 0], from_world[0, 0])
    return tuple(
        tuple(_box(agent, from_world, turn) for agent in (each.agents or ()))
        if each is not None
        else ()
        for each in later
    )


def _box(agent: Agent, from_world: Floats, turn: float) -> Box:
    x, y = (from_world[:2, :2] @ [agent.x, agent.y] + from_world[:2, 3]).tolist()
    return x, y, agent.heading + turn, agent.length, agent.width
