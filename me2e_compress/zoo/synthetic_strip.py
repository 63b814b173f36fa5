"""Three cameras as one wide image, and TCP's route inputs."""

from functools import cache

import numpy as np
from numpy.typing import NDArray

from me2e_compress.zoo.synthetic_cameras import SCALE
from me2e_compress.zoo.synthetic_world import FRAME_S, SyntheticWorld
from me2e_compress.zoo.tcp.config import COMMANDS, SPEED_UNIT_MPS

STRIP_HW = (256, 900)

FRONT, FRONT_LEFT, FRONT_RIGHT = 0, 1, 2
"""Indices of cameras among the six."""

CUTS = ((FRONT_LEFT, 0, 1400), (FRONT, 200, 1400), (FRONT_RIGHT, 200, 1600))
"""Camera, first and last column of 1600, from left to right (Bench2DriveZoo, branch
tcp/admlp, team_code/tcp_b2d_agent.py): 4000 columns, before they are made 900."""

TARGET_S = 4.0
"""How far ahead of the vehicle its target point is."""

FOLLOW_LANE = 3
"""Index among left, right, straight, follow, change left and change right."""


def strip(seen: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Join three of six images: [6, 360, 640, 3] to [256, 900, 3] grey levels."""
    parts = [seen[i, :, round(a * SCALE) : round(b * SCALE)] for i, a, b in CUTS]
    wide = np.concatenate(parts, axis=1).astype(np.float32)
    rows = interpolation(wide.shape[0], STRIP_HW[0])
    columns = interpolation(wide.shape[1], STRIP_HW[1])
    shrunk: NDArray[np.float32] = np.einsum(
        "hr,rwc,vw->hvc", rows, wide, columns, optimize=True
    )
    return shrunk


@cache
def interpolation(before: int, after: int) -> NDArray[np.float32]:
    """Return weights [after, before] of linear interpolation between pixel centres."""
    at = (np.arange(after) + 0.5) * before / after - 0.5
    at = np.clip(at, 0, before - 1)
    away = np.abs(at[:, None] - np.arange(before))
    weights: NDArray[np.float32] = np.maximum(1 - away, 0).astype(np.float32)
    return weights


def route_state(
    world: SyntheticWorld, step: int
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return state [1, 9] and target point [1, 2], as `Tcp.forward` takes them."""
    now = world.ego(step * FRAME_S)
    there = world.ego(step * FRAME_S + TARGET_S)
    right, ahead = now.to_lidar(there.x, there.y)
    target = np.array([[ahead, right]], np.float32)
    speed = world.speed_mps + world.accel_mps2 * step * FRAME_S
    command = np.eye(COMMANDS, dtype=np.float32)[FOLLOW_LANE : FOLLOW_LANE + 1]
    first = np.array([[speed / SPEED_UNIT_MPS]], np.float32)
    return np.concatenate([first, target, command], 1), target
