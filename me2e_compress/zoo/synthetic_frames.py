"""Synthetic calibration frames: scenes of a moving world seen by six cameras."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from me2e_compress.errors import FramesError
from me2e_compress.zoo.cameras import render, rig
from me2e_compress.zoo.stacks import Stack
from me2e_compress.zoo.synthetic_world import FRAME_S, SyntheticWorld
from me2e_compress.zoo.traffic import draw_world

Frame = dict[str, NDArray[np.float32]]

SENSOR_NOISE = 2.0
"""Standard deviation of pixel noise, in 1 / 255."""


def frames(spec: Stack, n: int, seed: int, scene_length: int = 8) -> Iterator[Frame]:
    """Make frames one by one, keyed by input name, without the recurrent inputs.

    Raises:
        FramesError: A count below 1.
    """
    if n < 1 or scene_length < 1:
        raise FramesError(f"{n} frames in scenes of {scene_length}: both must be >= 1")
    lidar2img = np.stack([camera.lidar2img() for camera in rig()])[None]
    for scene, start in enumerate(range(0, n, scene_length)):
        world = draw_world(np.random.default_rng([seed, scene]))
        for step in range(min(scene_length, n - start)):
            noise = np.random.default_rng([seed, scene, step + 1])
            seconds = step * FRAME_S
            seen = render(world, world.ego(seconds), world.boxes_at(seconds))
            yield {
                "img": _normalise(spec, seen, noise),
                "lidar2img": lidar2img,
                "can_bus": _can_bus(world, step),
            }


def _normalise(
    spec: Stack, seen: NDArray[np.uint8], noise: np.random.Generator
) -> NDArray[np.float32]:
    """[6, h, w, 3] RGB pixels to the image input, padded with zeros below."""
    grain = noise.normal(0, SENSOR_NOISE, seen.shape[:3])[..., None]
    pixels = np.clip(np.rint(seen + grain), 0, 255).astype(np.float32)
    mean = np.array(spec.image.mean, np.float32)
    std = np.array(spec.image.std, np.float32)
    out = np.zeros(spec.inputs["img"], np.float32)
    height, width = seen.shape[1:3]
    out[0, :, :, :height, :width] = ((pixels - mean) / std).transpose(0, 3, 1, 2)
    return out


def _can_bus(world: SyntheticWorld, step: int) -> NDArray[np.float32]:
    """What the vehicle says of its motion, [18] float32.

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
