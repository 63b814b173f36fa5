"""The command of a moment, from the moments after it."""

import numpy as np

from driving_logs.moments import CameraLog, LogMoment, LogScene

STEPS, STEP_S = 6, 0.5
"""Six steps of 0.5 s give the three seconds that UniAD and VAD plan."""
TOLERANCE_S = 0.25
"""Largest difference, half a step, between a moment's time and that of its step."""


def command_at(log: CameraLog, scene: LogScene, at: int) -> int:
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
    moved = np.linalg.inv(now.lidar_to_world) @ last.lidar_to_world
    return log.command_of(float(moved[0, 3]))


def _later(scene: LogScene, at: int, step: int, half_second: int) -> LogMoment | None:
    """Return the moment ``step`` half seconds later; None where the log has none."""
    index = at + step * half_second
    if index >= len(scene):
        return None
    found = scene[index]
    passed_s = (found.time_us - scene[at].time_us) / 1e6
    return found if abs(passed_s - step * STEP_S) <= TOLERANCE_S else None
