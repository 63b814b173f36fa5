"""What the cameras can show of a scene."""

from dataclasses import replace

import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import CAMERA_HEIGHT_M, CAMERAS
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Actor, Ego, Scene

RANGE_M = 80.0
"""Beyond it a car is 8 pixels wide or less in a picture of 160."""
LEAST = 0.4
"""Share of the rays that must arrive: two of five, so that a corner is not enough."""
AT = np.array([(0.0, 0.0), (0.9, 0.9), (0.9, -0.9), (-0.9, -0.9), (-0.9, 0.9)])
"""Ends of the rays on a box, as parts of half its length and width."""
HIGH = 0.75
"""Their height as a part of the box's."""


def seen(scene: Scene) -> Scene:
    """Return a scene with only those actors and signals that the cameras can show.

    The renderer paints boxes over boxes that are farther away, and the cameras look all
    around: an actor is seen if rays from a camera to its box pass no other box, which
    is what a depth image says, without its resolution.
    """
    ego = scene.ego
    near = [each for each in scene.actors if _away(ego, each.x, each.y) < RANGE_M]
    shown = visible(ego, near)
    return replace(
        scene,
        actors=tuple(
            each for each, is_seen in zip(near, shown, strict=True) if is_seen
        ),
        signals=tuple(e for e in scene.signals if _away(ego, e.x, e.y) < RANGE_M),
    )


def visible(ego: Ego, actors: list[Actor]) -> npt.NDArray[np.bool_]:
    """Return [A] whether enough rays reach each actor."""
    if not actors:
        return np.zeros(0, bool)
    rows = [(a.x, a.y, a.heading, a.length, a.width, a.height) for a in actors]
    boxes = np.array(rows, float)
    cos, sin = np.cos(boxes[:, 2]), np.sin(boxes[:, 2])
    # ends of the rays [A, 5, 2], each from the camera that looks there
    on_box = AT[None] * boxes[:, None, 3:5] / 2
    x = boxes[:, :1] + cos[:, None] * on_box[..., 0] - sin[:, None] * on_box[..., 1]
    y = boxes[:, 1:2] + sin[:, None] * on_box[..., 0] + cos[:, None] * on_box[..., 1]
    ends = np.stack([x, y], axis=-1).reshape(-1, 2)
    # the camera that looks most nearly at each end
    bearing = np.arctan2(ends[:, 1] - ego.y, ends[:, 0] - ego.x) - ego.heading
    yaws = np.deg2rad([camera.yaw_deg for camera in CAMERAS])
    apart = np.abs(np.angle(np.exp(1j * (bearing[:, None] - yaws))))
    places = np.array([(camera.x_m, camera.y_m) for camera in CAMERAS])
    eyes = ego.placed(places[np.argmin(apart, axis=1)])
    # where each ray enters and leaves each box, as parts of the ray: [R, A]
    enters, leaves = rays_through(eyes, ends, boxes[:, :5])
    crosses = (enters < leaves) & (leaves > 0.0) & (enters < 1.0)
    # over a low box a ray passes
    rise = np.repeat(HIGH * boxes[:, 5], len(AT))[:, None] - CAMERA_HEIGHT_M
    lowest = CAMERA_HEIGHT_M + np.minimum(
        rise * np.clip(enters, 0.0, 1.0), rise * np.clip(leaves, 0.0, 1.0)
    )
    blocked = crosses & (lowest < boxes[:, 5])
    own = np.repeat(np.arange(len(actors)), len(AT))
    blocked[np.arange(len(own)), own] = False
    arrive = ~blocked.any(axis=1).reshape(len(actors), len(AT))
    return np.asarray(arrive.mean(axis=1) >= LEAST)


def _away(ego: Ego, x: float, y: float) -> float:
    return float(np.hypot(x - ego.x, y - ego.y))


def rays_through(starts: Floats, ends: Floats, boxes: Floats) -> tuple[Floats, Floats]:
    """Return [R, B] the parts of R rays at which they enter and leave B boxes.

    Starts and ends are [R, 2]; where the first exceeds the second, a ray misses.
    """
    cos, sin, half = np.cos(boxes[:, 2]), np.sin(boxes[:, 2]), boxes[:, 3:5] / 2
    start, way = starts[:, None] - boxes[None, :, :2], (ends - starts)[:, None]
    enters, leaves = np.full(start.shape[:2], -np.inf), np.full(start.shape[:2], np.inf)
    for axis, (c, s) in enumerate(((cos, sin), (-sin, cos))):
        at = c * start[..., 0] + s * start[..., 1]
        step = c * way[..., 0] + s * way[..., 1]
        step = np.where(np.abs(step) < 1e-9, 1e-9, step)
        one, other = (-half[:, axis] - at) / step, (half[:, axis] - at) / step
        enters = np.maximum(enters, np.minimum(one, other))
        leaves = np.minimum(leaves, np.maximum(one, other))
    return enters, leaves
