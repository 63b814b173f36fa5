"""Synthetic calibration frames: random scenes of a moving world, six cameras."""

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from me2e_compress.errors import FramesError
from me2e_compress.zoo.stacks import Stack
from me2e_compress.zoo.synthetic_cameras import LIDAR_HEIGHT_M, render, rig
from me2e_compress.zoo.synthetic_strip import route_state, strip
from me2e_compress.zoo.synthetic_world import (
    FRAME_S,
    LANE_M,
    LANES,
    TILE,
    Cuboid,
    EgoPose,
    SyntheticWorld,
)

Frame = dict[str, NDArray[np.float32 | np.int64]]

SENSOR_NOISE = 2.0
"""Standard deviation of pixel noise, in 1 / 255."""


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
            known: Frame = {
                "img": _normalise(spec, seen, noise)[None],
                "lidar2img": lidar2img,
                "can_bus": _can_bus(world, step),
                **_place_and_time(world.ego(seconds), seconds),
                "command": np.array([spec.straight_on]),
            }
            wanted = spec.inputs.keys() - spec.recurrent.keys()
            yield {name: value for name, value in known.items() if name in wanted}


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
    out = np.zeros((len(seen), 3, *spec.inputs["img"][-2:]), np.float32)
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


Range = tuple[float, float]

TINT = 22.0
"""Standard deviation of a colour around its grey, in 1 / 255."""


def draw_world(rng: np.random.Generator) -> SyntheticWorld:
    """Draw a road with 8 to 12 vehicles, parked cars, buildings, people and cones."""
    bend = float(rng.uniform(-0.008, 0.008))
    speed_mps = float(rng.uniform(3, 10))
    # Objects by kind
    boxes = [
        *(_vehicle(rng, bend, speed_mps) for _ in range(int(rng.integers(8, 13)))),
        *(_parked(rng, bend) for _ in range(int(rng.integers(4, 8)))),
        *(_building(rng, bend) for _ in range(int(rng.integers(10, 15)))),
        *(_small(rng, bend) for _ in range(int(rng.integers(5, 9)))),
    ]
    # Ground texture of two scales
    coarse = rng.normal(0, 7, (TILE // 8, TILE // 8)).repeat(8, 0).repeat(8, 1)
    tile = (coarse + rng.normal(0, 6, (TILE, TILE))).astype(np.float32)
    return SyntheticWorld(
        bend=bend,
        crossing_m=float(rng.uniform(8, 40)),
        tile=tile,
        boxes=tuple(boxes),
        speed_mps=speed_mps,
        accel_mps2=float(rng.uniform(-0.7, 0.7)),
        lane_m=0.0,
    )


def _place(bend: float, along: float, aside: float) -> tuple[float, float, float]:
    """Return world x, y and yaw at a station and an offset of the road."""
    return along, bend * along**2 / 2 + aside, math.atan(bend * along)


def _colour(rng: np.random.Generator, bounds: Range) -> tuple[float, float, float]:
    red, green, blue = np.clip(rng.uniform(*bounds) + rng.normal(0, TINT, 3), 0, 255)
    return float(red), float(green), float(blue)


def _vehicle(rng: np.random.Generator, bend: float, ego_mps: float) -> Cuboid:
    """Draw a moving vehicle; in the ego's lane it is about as fast as the ego."""
    # Keep a gap around the ego vehicle in its lane
    lane = int(rng.integers(0, LANES)) - LANES // 2
    ahead = lane != 0 or rng.random() < 0.7
    along = float(rng.uniform(9, 60) if ahead else rng.uniform(-50, -9))
    if lane != 0:
        along = float(rng.uniform(-45, 60))
    x, y, yaw = _place(bend, along, lane * LANE_M)
    # A fifth of the vehicles are trucks
    truck = rng.random() < 0.2
    return Cuboid(
        x=x,
        y=y,
        yaw=yaw + (math.pi if lane == 1 else 0.0),
        length=float(rng.uniform(6.5, 9.5) if truck else rng.uniform(3.8, 4.9)),
        width=2.3 if truck else float(rng.uniform(1.7, 1.95)),
        height=float(rng.uniform(2.6, 3.4) if truck else rng.uniform(1.4, 1.8)),
        colour=_colour(rng, (30, 235)),
        speed_mps=ego_mps if lane == 0 else float(rng.uniform(4, 11)),
        window_m=None if truck else 1.6,
    )


def _parked(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    x, y, yaw = _place(bend, float(rng.uniform(-35, 55)), side * 6.4)
    return Cuboid(x, y, yaw, 4.4, 1.8, 1.5, _colour(rng, (30, 235)), window_m=1.5)


def _building(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    depth = float(rng.uniform(7, 14))
    offset = side * (float(rng.uniform(11, 20)) + depth / 2)
    x, y, yaw = _place(bend, float(rng.uniform(-55, 80)), offset)
    length, height = float(rng.uniform(9, 24)), float(rng.uniform(5, 17))
    return Cuboid(
        x, y, yaw, length, depth, height, _colour(rng, (90, 210)), window_m=2.8
    )


def _small(rng: np.random.Generator, bend: float) -> Cuboid:
    side = 1 if rng.random() < 0.5 else -1
    x, y, yaw = _place(bend, float(rng.uniform(-20, 40)), side * rng.uniform(6, 8.5))
    if rng.random() < 0.4:
        return Cuboid(x, y, yaw, 0.4, 0.4, 0.8, (236.0, 108.0, 32.0))
    pace = float(rng.uniform(0.6, 1.6))
    return Cuboid(x, y, yaw, 0.5, 0.5, 1.75, _colour(rng, (30, 220)), speed_mps=pace)
