"""The painting order of every camera: which solid hides which.

Far to near by distance is wrong for a long truck beside a small car. Two convex
footprints that do not overlap have an edge of one of them that separates them; the
solid on the camera's side of that edge is the nearer one. Distance orders first; where
two solids share columns of an image and their edges contradict it, the edges win.
"""

from typing import NamedTuple

import numpy as np
import numpy.typing as npt

Floats = npt.NDArray[np.float64]
Ints = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]

TOUCH_M = 0.05
"""Footprints that sink into each other by less still count as apart."""


class Edges(NamedTuple):
    """Corners [4, V], the outward normals of the edges after them and their places."""

    x: Floats
    y: Floats
    normal_x: Floats
    normal_y: Floats
    at: Floats
    """Position of the edge along its normal: negative if the camera is outside."""


def painting_order(right: Floats, forward: Floats, visible: Flags) -> tuple[Ints, Ints]:
    """Order the visible solids of every camera from far to near.

    ``right`` and ``forward`` [K, 4, S] are the corners of the solids' footprints in the
    frame of each of K cameras, which sit at the origin; convex, counter-clockwise from
    above. ``visible`` [K, S] is which solids a camera may see.

    Returns:
        Camera and solid, [V] each: camera by camera, the first to paint first.
    """
    # by distance, camera by camera
    nearest = np.hypot(right, forward).min(axis=1)
    camera, solid = np.nonzero(visible)
    order = np.lexsort((-nearest[camera, solid], camera))
    camera, solid = camera[order], solid[order]
    # pairs in the same columns whose separating edges contradict the distance
    x, y = right[camera, :, solid].T, forward[camera, :, solid].T
    first, second = _rivals(x, y, camera)
    if len(first) == 0:
        return camera, solid
    edges = _edges(x, y)
    before, after = _hides(edges, first, second)
    wrong = after & ~before
    # sort the cameras with such a pair anew, by the edges
    for k in np.unique(camera[first[wrong]]).tolist():
        low, high = np.searchsorted(camera, [k, k + 1]).tolist()
        behind = np.zeros((high - low, high - low), np.bool_)
        mine = camera[first] == k
        p, q = first[mine] - low, second[mine] - low
        behind[p, q] = (before & ~after)[mine]
        behind[q, p] = wrong[mine]
        solid[low:high] = solid[low:high][_sorted(behind)]
    return camera, solid


def _rivals(x: Floats, y: Floats, camera: Ints) -> tuple[Ints, Ints]:
    """Find the pairs (farther, nearer) that may share columns of a camera's image."""
    bearing = np.arctan2(x, y)
    low, high = bearing.min(axis=0), bearing.max(axis=0)
    wide = high - low > np.pi  # a footprint across the line straight behind
    apart = (low[:, None] > high) | (high[:, None] < low)
    shared = ~apart | wide[:, None] | wide
    first, second = np.nonzero(np.triu(shared & (camera[:, None] == camera), 1))
    return first, second


def _edges(x: Floats, y: Floats) -> Edges:
    following = [1, 2, 3, 0]
    normal_x, normal_y = y[following] - y, x - x[following]
    length = np.maximum(np.hypot(normal_x, normal_y), 1e-9)
    normal_x, normal_y = normal_x / length, normal_y / length
    return Edges(x, y, normal_x, normal_y, normal_x * x + normal_y * y)


def _hides(edges: Edges, first: Ints, second: Ints) -> tuple[Flags, Flags]:
    """Return whether an edge shows that second[i], or first[i], is the nearer solid.

    Either an edge of the farther solid has both the camera and the nearer one outside,
    or an edge of the nearer one has the camera inside.
    """
    one, other = _outside(edges, first, second), _outside(edges, second, first)
    out_one, out_other = (edges.at[:, solid] < 0.0 for solid in (first, second))
    before = (one & out_one) | (other & ~out_other)
    after = (other & out_other) | (one & ~out_one)
    return np.asarray(before.any(axis=0)), np.asarray(after.any(axis=0))


def _outside(edges: Edges, of: Ints, other: Ints) -> Flags:
    """Return [4, P]: all corners of one footprint lie outside each edge of another."""
    reach = edges.normal_x[:, None, of] * edges.x[:, other]
    reach += edges.normal_y[:, None, of] * edges.y[:, other]
    return np.asarray(reach.min(axis=1) - edges.at[:, of] > -TOUCH_M)


def _sorted(behind: Flags) -> list[int]:
    """Sort topologically: the farthest free solid first, also to break a cycle."""
    left, result = list(range(len(behind))), list[int]()
    while left:
        waits = behind[np.ix_(left, left)].any(axis=0)
        result.append(left.pop(int(np.argmin(waits))))
    return result
