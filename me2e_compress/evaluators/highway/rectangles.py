"""Oriented rectangles in the plane: gap, overlap, time to contact.

A box is a row (x, y, heading, length, width); arrays of boxes [..., 5] broadcast.
"""

from typing import Any

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]


def corners(boxes: Floats) -> Floats:
    """Return [..., 4, 2] corners: front left and right, rear right and left."""
    signs = np.array([[1.0, 1.0], [1.0, -1.0], [-1.0, -1.0], [-1.0, 1.0]])
    along = signs[:, 0] * boxes[..., 3:4] / 2
    left = signs[:, 1] * boxes[..., 4:5] / 2
    cos, sin = np.cos(boxes[..., 2:3]), np.sin(boxes[..., 2:3])
    x = boxes[..., 0:1] + along * cos - left * sin
    y = boxes[..., 1:2] + along * sin + left * cos
    return np.stack([x, y], axis=-1)


def overlaps(one: Floats, other: Floats) -> npt.NDArray[np.bool_]:
    """Return [...] whether two boxes touch or overlap (separating axes)."""
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    return np.asarray((np.abs(apart) <= _room(one, other)).all(axis=-1))


def gaps(one: Floats, other: Floats) -> Floats:
    """Return [...] metres between the outlines of two boxes, 0 where they overlap.

    Between disjoint convex outlines, a corner of one is the nearest point.
    """
    nearest = np.minimum(_from_corners(one, other), _from_corners(other, one))
    return np.where(overlaps(one, other), 0.0, nearest)


def contact_times(one: Floats, other: Floats, approach: Floats) -> Floats:
    """Return [...] seconds until two boxes touch, infinite if they never do.

    Both keep their heading and velocity; ``approach`` [..., 2] is the velocity of the
    other minus that of the first, m/s. The answer is exact: the boxes touch while their
    projections on all four axes overlap.
    """
    # interval of contact on each axis
    apart = _along_axes(one, other, other[..., :2] - one[..., :2])
    speed, room = _along_axes(one, other, approach), _room(one, other)
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        edges = np.stack([(-room - apart) / speed, (room - apart) / speed])
    begins, ends = edges.min(axis=0), edges.max(axis=0)
    # on an axis without motion, contact is always or never
    still, inside = speed == 0.0, np.abs(apart) <= room
    begins = np.where(still, np.where(inside, -np.inf, np.inf), begins).max(axis=-1)
    ends = np.where(still, np.where(inside, np.inf, -np.inf), ends).min(axis=-1)
    touches = (begins <= ends) & (ends >= 0.0)
    return np.where(touches, np.maximum(begins, 0.0), np.inf)


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


def _along_axes(one: Floats, other: Floats, vectors: Floats) -> Floats:
    """Return [..., 4] vectors along and across the first box and the other."""
    columns: list[Any] = []
    for box in (one, other):
        cos, sin = np.cos(box[..., 2]), np.sin(box[..., 2])
        columns.append(vectors[..., 0] * cos + vectors[..., 1] * sin)
        columns.append(vectors[..., 1] * cos - vectors[..., 0] * sin)
    return np.stack(columns, axis=-1)


def _room(one: Floats, other: Floats) -> Floats:
    """Return [..., 4] centre distances at contact, on each axis."""
    turn = other[..., 2] - one[..., 2]
    cos, sin = np.abs(np.cos(turn)), np.abs(np.sin(turn))
    columns = []
    for box, second in ((one, other), (other, one)):
        length, width = second[..., 3], second[..., 4]
        columns.append((box[..., 3] + length * cos + width * sin) / 2)
        columns.append((box[..., 4] + length * sin + width * cos) / 2)
    return np.stack(columns, axis=-1)


def _from_corners(one: Floats, other: Floats) -> Floats:
    """Return [...] the smallest distance of the first's corners to the other box."""
    away = corners(one) - other[..., None, :2]
    cos, sin = np.cos(other[..., 2:3]), np.sin(other[..., 2:3])
    along = np.abs(away[..., 0] * cos + away[..., 1] * sin) - other[..., 3:4] / 2
    across = np.abs(away[..., 1] * cos - away[..., 0] * sin) - other[..., 4:5] / 2
    outside = np.hypot(np.maximum(along, 0.0), np.maximum(across, 0.0))
    return np.asarray(outside.min(axis=-1))
