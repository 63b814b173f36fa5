"""Six pinhole cameras around a vehicle, and how they render painted boxes."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from models.synthetic_world import Cuboid, EgoPose, SyntheticWorld

Array = NDArray[np.floating[Any]]

SCALE = 0.4
"""VAD-tiny sees 1600 x 900 images at this scale."""

WIDTH, HEIGHT = 640, 360

FULL_HW = (900, 1600)

MOUNTS = (
    ("CAM_FRONT", 0.0, (0.0, 0.7, -0.33), (1266.0, 816.0, 491.0)),
    ("CAM_FRONT_LEFT", 55.0, (-0.5, 0.55, -0.35), (1272.0, 826.0, 480.0)),
    ("CAM_FRONT_RIGHT", -55.0, (0.5, 0.55, -0.35), (1260.0, 807.0, 495.0)),
    ("CAM_BACK", 180.0, (0.0, -0.9, -0.28), (809.0, 829.0, 482.0)),
    ("CAM_BACK_LEFT", 110.0, (-0.5, 0.2, -0.3), (1256.0, 792.0, 492.0)),
    ("CAM_BACK_RIGHT", -110.0, (0.5, 0.2, -0.3), (1259.0, 807.0, 501.0)),
)
"""Name, yaw in degrees (left positive), position in the lidar frame in metres (x right,
y forward, z up) and focal length and principal point in pixels of the full image:
rounded from the calibration of nuScenes (Caesar et al. 2020), order of Bench2Drive."""

LIDAR_HEIGHT_M = 1.84
"""Height of nuScenes' lidar above the ground."""

NEAR_M = 0.3
FAR_M = 1.0e6

SUN = np.array([0.45, 0.35, 0.82], np.float32)
SKY_LOW = np.array([214.0, 222.0, 232.0], np.float32)
SKY_HIGH = np.array([96.0, 148.0, 214.0], np.float32)


@dataclass(frozen=True)
class Pinhole:
    """A pinhole camera.

    Attributes:
        position: [3] metres, lidar frame.
        to_camera: [3, 3] lidar frame to camera (x right, y down, z forward).
        intrinsics: [3, 3] in pixels of the image.
        hw: pixels of the image, rows and columns.
    """

    position: Array
    to_camera: Array
    intrinsics: Array
    hw: tuple[int, int] = (HEIGHT, WIDTH)

    def lidar2img(self) -> Array:
        """Return [4, 4]: lidar metres to (u * depth, v * depth, depth, 1)."""
        out = np.eye(4, dtype=np.float32)
        out[:3, :3] = self.intrinsics @ self.to_camera
        out[:3, 3] = -out[:3, :3] @ self.position
        return out

    def rays(self) -> Array:
        """Return [h, w, 3] rays through the pixel centres, depth 1, lidar frame."""
        focal, cx, cy = (
            self.intrinsics[0, 0],
            self.intrinsics[0, 2],
            self.intrinsics[1, 2],
        )
        v, u = np.mgrid[: self.hw[0], : self.hw[1]].astype(np.float32) + np.float32(0.5)
        flat = np.stack([(u - cx) / focal, (v - cy) / focal, np.ones_like(u)], -1)
        return np.ascontiguousarray(flat @ self.to_camera)


@cache
def rig(scale: float = SCALE) -> tuple[Pinhole, ...]:
    """Return the six cameras, in the order of the image input."""
    hw = round(FULL_HW[0] * scale), round(FULL_HW[1] * scale)
    cameras = []
    for _, yaw_deg, position, (focal, cx, cy) in MOUNTS:
        # Axes of the camera in the lidar frame
        yaw = math.radians(yaw_deg)
        ahead = (-math.sin(yaw), math.cos(yaw), 0.0)
        right = (math.cos(yaw), math.sin(yaw), 0.0)
        cameras.append(
            Pinhole(
                np.array(position, np.float32),
                np.array([right, (0.0, 0.0, -1.0), ahead], np.float32),
                np.array(
                    [
                        [focal * scale, 0, cx * scale],
                        [0, focal * scale, cy * scale],
                        [0, 0, 1],
                    ],
                    np.float32,
                ),
                hw,
            )
        )
    return tuple(cameras)


@cache
def _rays(scale: float) -> tuple[Array, ...]:
    return tuple(camera.rays() for camera in rig(scale))


def render(
    world: SyntheticWorld,
    ego: EgoPose,
    boxes: Sequence[Cuboid],
    scale: float = SCALE,
) -> NDArray[np.uint8]:
    """Draw the images of the six cameras, [6, h, w, 3] RGB, 360 x 640 by default.

    Boxes are in world coordinates; ``scale`` is relative to 1600 x 900 images.
    """
    cameras = rig(scale)
    images = np.empty((len(cameras), *cameras[0].hw, 3), np.uint8)
    for image, camera, rays in zip(images, cameras, _rays(scale), strict=True):
        colour, depth = _background(world, ego, camera, rays)
        for box in boxes:
            _draw(box, ego, camera, rays, colour, depth)
        haze = np.exp(-depth / 220.0)[..., None]
        colour = colour * haze + SKY_LOW * (1 - haze)
        image[:] = np.clip(colour, 0, 255)
    return images


def _background(
    world: SyntheticWorld, ego: EgoPose, camera: Pinhole, rays: Array
) -> tuple[Array, Array]:
    # The sky by elevation
    rise = np.clip(rays[..., 2:] / 0.5, 0, 1)
    colour = SKY_LOW * (1 - rise) + SKY_HIGH * rise
    depth = np.full(rays.shape[:2], np.float32(0))
    # The ground where rays go down
    down = rays[..., 2] < -0.01
    height = camera.position[2] + LIDAR_HEIGHT_M
    reach = -height / rays[..., 2][down]
    right = camera.position[0] + reach * rays[..., 0][down]
    ahead = camera.position[1] + reach * rays[..., 1][down]
    x, y = ego.to_world(right, ahead)
    colour[down] = world.ground(x, y)
    depth[down] = reach
    depth[~down] = 0
    return colour, depth


def _draw(
    box: Cuboid, ego: EgoPose, camera: Pinhole, rays: Array, colour: Array, depth: Array
) -> None:
    """Cast the rays that may hit the box, and paint the nearest hits."""
    window = _window(box, ego, camera)
    if window is None:
        return
    # Rays in the frame of the box
    cos, sin = math.cos(ego.yaw - box.yaw), math.sin(ego.yaw - box.yaw)
    right, ahead = ego.to_lidar(box.x, box.y)
    start = camera.position - np.array([right, ahead, -LIDAR_HEIGHT_M], np.float32)
    turn = np.array([[sin, -cos, 0], [cos, sin, 0], [0, 0, 1]], np.float32).T
    origin, towards = turn.T @ start, rays[window] @ turn
    half = np.array([box.length / 2, box.width / 2, box.height / 2], np.float32)
    origin[2] -= half[2]
    # Slab method: enter and leave per axis
    with np.errstate(divide="ignore", invalid="ignore"):
        one, other = (-half - origin) / towards, (half - origin) / towards
    enter = np.minimum(one, other)
    leave = np.maximum(one, other)
    near = np.maximum(np.maximum(enter[..., 0], enter[..., 1]), enter[..., 2])
    far = np.minimum(np.minimum(leave[..., 0], leave[..., 1]), leave[..., 2])
    hit = (near < far) & (near > NEAR_M)
    behind = depth[window]
    hit &= (near < behind) | (behind == 0)
    if not hit.any():
        return
    # Paint the side that was entered last
    axis = enter[hit].argmax(-1)
    at = origin + towards[hit] * near[hit][:, None]
    colour[window][hit] = box.paint(at, half, axis, turn.T @ SUN)
    behind[hit] = near[hit]


def _window(box: Cuboid, ego: EgoPose, camera: Pinhole) -> tuple[slice, slice] | None:
    """Return the rows and columns that the box may touch, or None."""
    x, y, z = box.corners()
    right, ahead = ego.to_lidar(x, y)
    points = np.stack([right, ahead, z - LIDAR_HEIGHT_M], -1) - camera.position
    seen = points @ camera.to_camera.T
    depth = seen[:, 2]
    if depth.max() < NEAR_M:
        return None
    if depth.min() < NEAR_M:
        return slice(0, camera.hw[0]), slice(0, camera.hw[1])
    uv = (seen @ camera.intrinsics.T)[:, :2] / depth[:, None]
    low, high = np.floor(uv.min(0)).astype(int), np.ceil(uv.max(0)).astype(int)
    columns = slice(max(int(low[0]), 0), min(int(high[0]) + 1, camera.hw[1]))
    rows = slice(max(int(low[1]), 0), min(int(high[1]) + 1, camera.hw[0]))
    empty = columns.start >= columns.stop or rows.start >= rows.stop
    return None if empty else (rows, columns)
