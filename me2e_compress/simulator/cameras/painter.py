"""Solids as polygons in the six images.

The painting order of every camera: which solid hides which.

Far to near by distance is wrong for a long truck beside a small car. Two convex
footprints that do not overlap have an edge of one of them that separates them; the
solid on the camera's side of that edge is the nearer one. Distance orders first; where
two solids share columns of an image and their edges contradict it, the edges win.
"""

from dataclasses import dataclass
from functools import lru_cache

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import (
    CAMERA_HEIGHT_M,
    SUBPIXEL_BITS,
    CameraRig,
    fixed_point,
)
from me2e_compress.simulator.cameras.solids import Solid
from me2e_compress.simulator.cameras.template import FIRST_LAMP, Template
from me2e_compress.simulator.plane_geometry import Floats
from me2e_compress.simulator.scene import Ego

Bytes = npt.NDArray[np.uint8]
Ints = npt.NDArray[np.intp]
Flags = npt.NDArray[np.bool_]

TOUCH_M = 0.05  # footprints that sink into each other by less still count as apart
NEAR_M = 0.2  # polygons are cut at this depth
LEAST_PX = np.array([2.0, 0.7])  # smaller details are left out: others, lamps
LIMIT_PX = 20_000.0  # far outside any image, and safe in cv2's fixed-point numbers


def painting_order(right: Floats, forward: Floats, visible: Flags) -> tuple[Ints, Ints]:
    """Order the visible solids of every camera from far to near.

    ``right`` and ``forward`` [K, 4, S] are the corners of the solids' footprints in the
    frame of each of K cameras, which sit at the origin; convex, counter-clockwise from
    above. ``visible`` [K, S] is which solids a camera may see.

    Returns:
        Camera and solid, [V] each: camera by camera, the first to paint first.
    """
    # Sort by distance, camera by camera
    nearest = np.hypot(right, forward).min(axis=1)
    camera, solid = np.nonzero(visible)
    order = np.lexsort((-nearest[camera, solid], camera))
    camera, solid = camera[order], solid[order]
    # Pairs in the same columns whose separating edges contradict the distance
    x, y = right[camera, :, solid].T, forward[camera, :, solid].T
    bearing = np.arctan2(x, y)
    low, high = bearing.min(axis=0), bearing.max(axis=0)
    wide = high - low > np.pi  # a footprint across the line straight behind
    apart = (low[:, None] > high) | (high[:, None] < low)
    shared = (~apart | wide[:, None] | wide) & (camera[:, None] == camera)
    first, second = np.nonzero(shared)
    first, second = first[first < second], second[first < second]
    if len(first) == 0:
        return camera, solid
    before, after = _hides(x, y, first, second)
    wrong = after & ~before
    # Sort the cameras with such a pair anew, by the edges
    for k in np.unique(camera[first[wrong]]).tolist():
        begin, end = np.searchsorted(camera, [k, k + 1]).tolist()
        behind = np.zeros((end - begin, end - begin), np.bool_)
        mine = camera[first] == k
        p, q = first[mine] - begin, second[mine] - begin
        behind[p, q] = (before & ~after)[mine]
        behind[q, p] = wrong[mine]
        solid[begin:end] = solid[begin:end][_sorted(behind)]
    return camera, solid


def _hides(x: Floats, y: Floats, first: Ints, second: Ints) -> tuple[Flags, Flags]:
    """Return whether an edge shows that second[i], or first[i], is the nearer solid."""
    # x and y are corners (4, V). Either an edge of the farther solid has both the
    # camera and the nearer one outside, or an edge of the nearer one has the camera
    # inside.
    # Outward normals of the edges that follow the corners
    following = [1, 2, 3, 0]
    normal_x, normal_y = y[following] - y, x - x[following]
    length = np.maximum(np.hypot(normal_x, normal_y), 1e-9)
    normal_x, normal_y = normal_x / length, normal_y / length
    # Where an edge lies along its normal: negative if the camera is outside
    at = normal_x * x + normal_y * y
    # [4, P] edges of one footprint with all corners of the other outside
    outside = []
    for one, other in ((first, second), (second, first)):
        reach = normal_x[:, None, one] * x[:, other]
        reach += normal_y[:, None, one] * y[:, other]
        outside.append(reach.min(axis=1) - at[:, one] > -TOUCH_M)
    camera_outside = [at[:, solid] < 0.0 for solid in (first, second)]
    before = (outside[0] & camera_outside[0]) | (outside[1] & ~camera_outside[1])
    after = (outside[1] & camera_outside[1]) | (outside[0] & ~camera_outside[0])
    return np.asarray(before.any(axis=0)), np.asarray(after.any(axis=0))


def _sorted(behind: Flags) -> list[int]:
    """Sort topologically: the farthest free solid first, also to break a cycle."""
    waiting, result = list(range(len(behind))), list[int]()
    while waiting:
        hidden = behind[np.ix_(waiting, waiting)].any(axis=0)
        result.append(waiting.pop(int(np.argmin(hidden))))
    return result


@dataclass(frozen=True, eq=False)
class Faces:
    """Visible polygons of all cameras, in painting order."""

    cameras: Ints  # (faces,) index of the camera
    polygons: list[npt.NDArray[np.int32]]  # (corners, 2) each, fixed-point pixels
    colours: Floats  # (faces, 3) RGB
    lamps: Flags  # (faces,) whether it emits light
    details: Flags  # (faces,) whether it lies on another face
    places: Floats  # (faces, 2) position of its solid in the ego frame (m)
    distances: Floats  # (faces,) metres from its solid to the camera


@dataclass(frozen=True, eq=False)
class Painter:
    """Turns solids into the polygons that a rig sees."""

    rig: CameraRig

    def faces(self, solids: list[Solid], ego: Ego) -> Faces:
        """Cull, order, cut at the near plane and project one solid or more."""
        # which solids each camera may see, in painting order
        x, y, heading = np.array([s.pose for s in solids]).T
        poses = np.column_stack([ego.seen(x, y), heading - ego.heading])  # (solids, 3)
        shapes = _shapes(tuple((s.template, s.size) for s in solids))
        turns = np.stack([np.cos(poses[:, 2]), np.sin(poses[:, 2]), *poses[:, :2].T])
        corners = _placed(shapes.corners, turns.take(shapes.owner, axis=1))
        footprints = _placed(shapes.footprints, turns)
        camera, solid = painting_order(*self._views(footprints))
        # their faces that look at the camera, inside its frustum
        view, face = _spread(shapes.counts, solid)
        placed = corners.take(face, axis=2)  # (3, 4, faces) in the ego frame
        right, forward = self._right_and_forward(placed, camera[view])
        points = np.stack([right, CAMERA_HEIGHT_M - placed[2], forward])
        visible = self._visible(points, camera[view])
        points, view, face = points.take(visible, 2), view[visible], face[visible]
        # details that are large enough to be seen
        pixels = self._project(points, camera[view])
        details, lamps = shapes.details[face], shapes.lamps[face]
        sides = (pixels.max(axis=1) - pixels.min(axis=1)).max(axis=0)
        keep = np.flatnonzero(~details | (sides > LEAST_PX[lamps.astype(int)]))
        view, face = view[keep], face[keep]
        camera, solid = camera[view], solid[view]
        away = poses[solid, :2] - self.rig.positions[camera, :2]
        return Faces(
            cameras=camera,
            polygons=self._polygons(points.take(keep, 2), pixels.take(keep, 2), camera),
            colours=np.concatenate([s.colours for s in solids])[face],
            lamps=lamps[keep],
            details=details[keep],
            places=poses[solid, :2],
            distances=np.hypot(away[:, 0], away[:, 1]),
        )

    def _views(self, footprints: Floats) -> tuple[Floats, Floats, Flags]:
        """Return footprints [6, 4, S] in each camera's frame, and which it may see."""
        every = np.arange(len(self.rig.positions))[:, None, None]
        right, forward = self._right_and_forward(footprints, every)
        edge = forward * (self.rig.centre_px[0] / self.rig.focals_px)[:, None, None]
        hidden = np.asarray((forward < NEAR_M).all(axis=1))
        hidden |= (right > edge).all(axis=1) | (right < -edge).all(axis=1)
        return right, forward, ~hidden

    def _right_and_forward(self, points: Floats, camera: Ints) -> tuple[Floats, Floats]:
        """Convert x and y (points[0], points[1]) of the ego frame to cameras' axes."""
        dx, dy = (points[i] - self.rig.positions[:, i].take(camera) for i in (0, 1))
        (rx, ry), (fx, fy) = self.rig.rotations[:, ::2, :2].transpose(1, 2, 0)
        right = rx.take(camera) * dx + ry.take(camera) * dy
        return right, fx.take(camera) * dx + fy.take(camera) * dy

    def _visible(self, points: Floats, camera: Ints) -> Ints:
        """Return the indices of the faces [3, 4, M] that a camera sees."""
        # those that look at the camera, by their diagonals
        (ax, ay, az), (bx, by, bz) = (points[:, i] - points[:, i - 2] for i in (2, 3))
        x, y, z = points[:, 0]
        volume = x * (ay * bz - az * by)
        volume = volume + y * (az * bx - ax * bz) + z * (ax * by - ay * bx)
        front = np.flatnonzero(volume < 0.0)
        # and lie in its frustum
        right, down, depth = points.take(front, axis=2)
        centre_column, horizon = self.rig.centre_px
        slope = depth / self.rig.focals_px[camera[front]]
        outside = (depth < NEAR_M).all(axis=0)
        for across, low, high in (
            (right, centre_column, self.rig.width - centre_column),
            (down, horizon, self.rig.height - horizon),
        ):
            outside |= (across < -(low + 1.0) * slope).all(axis=0)
            outside |= (across > (high + 1.0) * slope).all(axis=0)
        return np.asarray(front[~outside])

    def _project(self, points: Floats, camera: Ints) -> Floats:
        """Project to [2, 4, M] pixels; corners before the near plane come out wrong."""
        scale = self.rig.focals_px[camera] / np.maximum(points[2], NEAR_M)
        pixels = points[:2] * scale
        pixels += np.array(self.rig.centre_px)[:, None, None]
        return np.asarray(pixels)

    def _polygons(
        self, points: Floats, pixels: Floats, camera: Ints
    ) -> list[npt.NDArray[np.int32]]:
        """Return the pixels of faces, which are cut where they cross the near plane."""
        polygons = list(_fixed(pixels.transpose(2, 1, 0)))
        for i in np.flatnonzero((points[2] < NEAR_M).any(axis=0)).tolist():
            clipped = _cut(points[:, :, i].T.tolist())
            scale = self.rig.focals_px[camera[i]] / clipped[:, 2:]
            polygons[i] = _fixed(clipped[:, :2] * scale + self.rig.centre_px)
        return polygons


def draw(images: Bytes, faces: Faces, colours: Bytes) -> None:
    """Paint faces with uint8 colours [M, 3] into uint8 [6, H, W, 3], antialiased."""
    fill, planes = cv2.fillConvexPoly, list(images)
    rows = zip(faces.cameras.tolist(), faces.polygons, colours.tolist(), strict=True)
    for camera, polygon, colour in rows:
        fill(planes[camera], polygon, colour, cv2.LINE_AA, SUBPIXEL_BITS)


@dataclass(frozen=True, eq=False)
class _Shapes:
    """What some solids have alike in every frame, each in its own frame, in metres."""

    corners: Floats  # (3, 4, faces)
    footprints: Floats  # (2, 4, solids)
    owner: Ints  # (faces,) index of the solid
    counts: Ints  # (solids,) faces of each
    details: Flags  # (faces,)
    lamps: Flags  # (faces,)


@lru_cache(maxsize=4)  # the solids near the ego are mostly those of the frame before
def _shapes(solids: tuple[tuple[Template, tuple[float, float, float]], ...]) -> _Shapes:
    """Join solids, each a template and its length, width and height (m)."""
    templates, sizes = [one for one, _ in solids], np.array([m for _, m in solids]).T
    counts = np.array([len(one.slots) for one in templates])
    owner = np.repeat(np.arange(len(solids)), counts)
    return _Shapes(
        np.concatenate([one.corners for one in templates], axis=2)
        * sizes[:, None, owner],
        np.stack([one.footprint for one in templates], axis=2) * sizes[:2, None],
        owner,
        counts,
        np.concatenate([one.details for one in templates]),
        np.concatenate([one.slots for one in templates]) >= FIRST_LAMP,
    )


def _placed(points: Floats, turns: Floats) -> Floats:
    """Return points [2 or 3, 4, N], turned by N cosines and sines and moved by x, y."""
    (cos, sin, x, y), placed = turns, points.copy()
    placed[0] = cos * points[0] - sin * points[1] + x
    placed[1] = sin * points[0] + cos * points[1] + y
    return placed


def _spread(counts: Ints, solid: Ints) -> tuple[Ints, Ints]:
    """Return, for the faces of the solids seen, the view [M] and the face [M]."""
    many = counts[solid]
    view = np.repeat(np.arange(len(solid)), many)
    within = np.arange(len(view)) - np.repeat(np.cumsum(many) - many, many)
    return view, (np.cumsum(counts) - counts)[solid][view] + within


def _cut(polygon: list[list[float]]) -> Floats:
    """Return the part [N, 3] of a polygon (x, y, depth) before the near plane."""
    clipped = list[list[float]]()
    for a, b in zip(polygon, polygon[1:] + polygon[:1], strict=True):
        if a[2] >= NEAR_M:
            clipped.append(a)
        if (a[2] >= NEAR_M) != (b[2] >= NEAR_M):
            part = (NEAR_M - a[2]) / (b[2] - a[2])
            clipped.append([p + part * (q - p) for p, q in zip(a, b, strict=True)])
    return np.array(clipped)


def _fixed(pixels: Floats) -> npt.NDArray[np.int32]:
    return fixed_point(np.clip(pixels, 0.5 - LIMIT_PX, 0.5 + LIMIT_PX))
