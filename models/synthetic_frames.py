"""Synthetic calibration frames: random scenes of a moving world, as stacks see it."""

import math
from collections.abc import Iterator, Sequence
from functools import cache

import numpy as np
from numpy.typing import NDArray

from me2e_compress.base.errors import FramesError
from models.lead.config import TARGET_POINTS
from models.stacks import Stack
from models.synthetic_cameras import LIDAR_HEIGHT_M, SCALE, render, rig
from models.synthetic_lidar import raster
from models.synthetic_world import (
    FRAME_S,
    EgoPose,
    SyntheticWorld,
    draw_world,
)
from models.tcp.config import COMMANDS, SPEED_UNIT_MPS

Frame = dict[str, NDArray[np.float32 | np.int64]]

SENSOR_NOISE = 2.0
"""Standard deviation of pixel noise, in 1 / 255."""

FRONT, FRONT_LEFT, FRONT_RIGHT = 0, 1, 2
"""Indices of cameras among the six."""

CUTS = ((FRONT_LEFT, 0, 1400), (FRONT, 200, 1400), (FRONT_RIGHT, 200, 1600))
"""Camera, first and last column of 1600, from left to right (Bench2DriveZoo, branch
tcp/admlp, team_code/tcp_b2d_agent.py): 4000 columns, before they are made 900."""

SQUARES = ((FRONT_LEFT, 350, 1250), (FRONT, 350, 1250), (FRONT_RIGHT, 350, 1250))
"""The middle of each: LEAD's cameras are square (autonomousvision/lead,
config_base.py)."""

TARGET_S = 4.0
"""How far ahead of the vehicle its target point is."""

FOLLOW_LANE = 3
"""Index among left, right, straight, follow, change left and change right."""


def frames(
    spec: Stack, n: int, seed: int, scene_length: int = 8, first: int = 0
) -> Iterator[Frame]:
    """Yield ``n`` frames by input name, without the recurrent inputs.

    Frame ``first`` must begin a scene; counts below 1 are a FramesError.
    """
    if n < 1 or scene_length < 1:
        raise FramesError(
            f"{n} frames in scenes of {scene_length}: both must be at least 1"
        )
    # One world per scene
    cameras = rig(spec.scale)
    lidar2img = np.stack([camera.lidar2img() for camera in cameras])[None]
    for start in range(first, n, scene_length):
        scene = start // scene_length
        world = draw_world(np.random.default_rng([seed, scene]))
        for step in range(min(scene_length, n - start)):
            # Each frame has its own noise, whatever was drawn before
            noise = np.random.default_rng([seed, scene, step + 1])
            seconds = step * FRAME_S
            boxes = world.boxes_at(seconds)
            seen = render(world, world.ego(seconds), boxes, spec.scale)
            if spec.sees == "strip":
                state, target = route_state(world, step)
                image = _normalise(spec, strip(seen)[None], noise)
                yield {"img": image, "state": state, "target_point": target}
                continue
            if spec.sees == "strip and lidar":
                yield _strip_and_lidar(spec, world, step, seen, noise)
                continue
            known: Frame = {
                "img": _normalise(spec, seen, noise)[None],
                "lidar2img": lidar2img,
                "can_bus": _can_bus(world, step),
                **_place_and_time(world.ego(seconds), seconds),
                "command": np.array([spec.straight_on]),
            }
            wanted = spec.inputs.keys() - spec.recurrent.keys()
            yield {name: value for name, value in known.items() if name in wanted}


def _strip_and_lidar(
    spec: Stack,
    world: SyntheticWorld,
    step: int,
    seen: NDArray[np.uint8],
    noise: np.random.Generator,
) -> Frame:
    """Return what LEAD sees, and its route as three points."""
    seconds = step * FRAME_S
    now = world.ego(seconds)
    wide = strip(seen, SQUARES, spec.inputs["rgb"][-2:])[None]
    hw = spec.inputs["rasterized_lidar"][-2:]
    # Where the vehicle is to be, was, and is to be after that
    points: Frame = {}
    for name, away in zip(TARGET_POINTS, (1, -1, 2), strict=True):
        there = world.ego(seconds + away * TARGET_S)
        right, ahead = now.to_lidar(there.x, there.y)
        points[name] = np.array([[ahead, right]], np.float32)
    return {
        "rgb": _normalise(spec, wide, noise),
        "rasterized_lidar": raster(now, world.boxes_at(seconds), hw, noise)[None, None],
        "speed": np.array([world.speed_mps + world.accel_mps2 * seconds], np.float32),
        "command": _follow_lane(),
        **points,
    }


def _normalise(
    spec: Stack, seen: NDArray[np.uint8 | np.float32], noise: np.random.Generator
) -> NDArray[np.float32]:
    """Convert [n, h, w, 3] RGB pixels to [n, 3, H, W], zero-padded at the bottom."""
    # Sensor noise, then rounding to grey levels
    grain = noise.normal(0, SENSOR_NOISE, seen.shape[:3])[..., None]
    pixels = np.clip(np.rint(seen + grain), 0, 255).astype(np.float32)
    mean = np.array(spec.image.mean, np.float32)
    std = np.array(spec.image.std, np.float32)
    if spec.image.order == "bgr":
        pixels = pixels[..., ::-1]
    out = np.zeros((len(seen), 3, *spec.inputs[spec.image_input][-2:]), np.float32)
    height, width = seen.shape[1:3]
    out[:, :, :height, :width] = ((pixels - mean) / std).transpose(0, 3, 1, 2)
    return out


def _place_and_time(ego: EgoPose, seconds: float) -> Frame:
    """Return position, orientation (its axes as rows) and time of the lidar."""
    cos, sin = math.cos(ego.yaw), math.sin(ego.yaw)
    axes = np.array([[sin, -cos, 0], [cos, sin, 0], [0, 0, 1]], np.float32)
    return {
        "l2g_r_mat": axes[None],
        "l2g_t": np.array([[ego.x, ego.y, LIDAR_HEIGHT_M]], np.float32),
        "timestamp": np.array([seconds], np.float32),
    }


def _can_bus(world: SyntheticWorld, step: int) -> NDArray[np.float32]:
    """Return the vehicle's motion as CAN bus, [18] float32.

    0-2 metres moved since the last frame (world axes), 3-6 quaternion, 7 speed, 10-12
    acceleration, 13-15 angular rate, 16 yaw in radians, 17 change of yaw in degrees;
    the changes are zero at the start of a scene.
    """
    now, before = world.ego(step * FRAME_S), world.ego(max(step - 1, 0) * FRAME_S)
    turned = now.yaw - before.yaw
    out = np.zeros(18, np.float32)
    out[0:2] = now.x - before.x, now.y - before.y
    out[3], out[6] = math.cos(now.yaw / 2), math.sin(now.yaw / 2)
    out[7] = world.speed_mps + world.accel_mps2 * step * FRAME_S
    out[10] = world.accel_mps2
    out[15] = turned / FRAME_S
    out[16], out[17] = now.yaw, math.degrees(turned)
    return out


def strip(
    seen: NDArray[np.uint8],
    cuts: Sequence[tuple[int, int, int]] = CUTS,
    hw: tuple[int, ...] = (256, 900),
) -> NDArray[np.float32]:
    """Join three of six images, [6, 360, 640, 3] to [h, w, 3] grey levels."""
    parts = [seen[i, :, round(a * SCALE) : round(b * SCALE)] for i, a, b in cuts]
    wide = np.concatenate(parts, axis=1).astype(np.float32)
    rows = interpolation(wide.shape[0], hw[0])
    columns = interpolation(wide.shape[1], hw[1])
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
    first = np.array([[speed / SPEED_UNIT_MPS]], np.float32)
    return np.concatenate([first, target, _follow_lane()], 1), target


def _follow_lane() -> NDArray[np.float32]:
    """Return the command as TCP and LEAD take it, one-hot."""
    return np.eye(COMMANDS, dtype=np.float32)[FOLLOW_LANE : FOLLOW_LANE + 1]
