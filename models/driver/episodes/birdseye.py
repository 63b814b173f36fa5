"""The pixel classes seen from above, in the ego frame."""

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.camera_rig import SUBPIXEL_BITS, fixed_point
from me2e_compress.simulator.cameras.ground import RESOLUTION_M, GroundTexture
from me2e_compress.simulator.scene import Actor, ActorKind, Ego, PixelClass, Scene

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]

ACTOR_CLASSES = {
    ActorKind.CAR: PixelClass.VEHICLE,
    ActorKind.VAN: PixelClass.VEHICLE,
    ActorKind.TRUCK: PixelClass.VEHICLE,
    ActorKind.EMERGENCY: PixelClass.VEHICLE,
    ActorKind.PARKED: PixelClass.VEHICLE,
    ActorKind.DOOR: PixelClass.VEHICLE,
    ActorKind.BICYCLE: PixelClass.BICYCLE,
    ActorKind.PEDESTRIAN: PixelClass.PEDESTRIAN,
    ActorKind.CONE: PixelClass.STATIC,
    ActorKind.BARRIER: PixelClass.STATIC,
}
"""The class of the ground under an actor."""


@dataclass(frozen=True, slots=True)
class BirdseyeGrid:
    """A grid in the ego frame: row 0 is farthest ahead, column 0 farthest left.

    Cell (r, c) covers x from front_m - (r + 1) * cell_m to front_m - r * cell_m and y
    from left_m - (c + 1) * cell_m to left_m - c * cell_m.

    Args:
        front_m: x of the upper edge.
        left_m: y of the left edge.
        cell_m: Side of a cell.
        rows: Number of rows.
        columns: Number of columns.
    """

    front_m: float = 51.2
    left_m: float = 51.2
    cell_m: float = 0.512
    rows: int = 200
    columns: int = 200

    def __post_init__(self) -> None:
        if self.cell_m <= 0 or self.rows < 1 or self.columns < 1:
            raise EvaluationError(
                f"bird's-eye grid of {self.rows} x {self.columns} cells of "
                f"{self.cell_m} m is empty: all three must be positive"
            )

    def cells(self, points: Floats) -> Floats:
        """Convert ego-frame points [..., 2] to continuous cells (column, row)."""
        x, y = points[..., 0], points[..., 1]
        return np.stack([self.left_m - y, self.front_m - x], axis=-1) / self.cell_m


def bev_classes(scene: Scene, texture: GroundTexture, grid: BirdseyeGrid) -> Bytes:
    """Return the `PixelClass` at the centre of each cell, uint8 [rows, columns].

    Signals have no extent on the ground and are left out; the ego is drawn last.
    """
    labels = ground_classes(scene.ego, texture, grid)
    for actor in scene.actors:
        _fill(labels, _footprint(actor, scene.ego), ACTOR_CLASSES[actor.kind], grid)
    _fill(labels, _footprint(scene.ego, scene.ego), PixelClass.EGO, grid)
    return labels


def ground_classes(ego: Ego, texture: GroundTexture, grid: BirdseyeGrid) -> Bytes:
    """Return the `PixelClass` of the ground at each cell's centre, without actors.

    The result is uint8 [rows, columns]; the grid lies at ``ego``.
    """
    # an affine map from cells to texels
    cos, sin = np.cos(ego.heading), np.sin(ego.heading)
    scale = grid.cell_m / RESOLUTION_M
    # one row down is one cell back, one column right is one cell to the right
    down = -scale * np.array([cos, -sin])
    right = scale * np.array([sin, cos])
    x, y = grid.front_m, grid.left_m
    east = ego.x + cos * x - sin * y - texture.west_m
    south = texture.north_m - (ego.y + sin * x + cos * y)
    corner = np.array([east, south]) / RESOLUTION_M + (down + right) / 2 - 0.5
    return np.asarray(
        cv2.warpAffine(
            texture.classes,
            np.stack([right, down, corner], axis=1),
            (grid.columns, grid.rows),
            flags=cv2.INTER_NEAREST | cv2.WARP_INVERSE_MAP,
            borderMode=cv2.BORDER_REPLICATE,
        ),
        np.uint8,
    )


def covered(actors: Sequence[Actor], ego: Ego, grid: BirdseyeGrid) -> Flags:
    """Return whether each cell is touched by an actor: bool [rows, columns].

    ``ego`` may be of another instant than the actors.
    """
    touched = np.zeros((grid.rows, grid.columns), np.uint8)
    # leave out those that cannot touch the grid: most are far, and cost as much
    boxes = np.array([(a.x, a.y, a.length, a.width) for a in actors]).reshape(-1, 4)
    cells = grid.cells(ego.seen(boxes[:, 0], boxes[:, 1]))
    # half a diagonal, and a cell for the rounding of what is drawn
    reach = np.hypot(boxes[:, 2], boxes[:, 3])[:, None] / (2 * grid.cell_m) + 1
    far = (cells < -reach) | (cells - reach > (grid.columns, grid.rows))
    for i in np.flatnonzero(~far.any(axis=1)).tolist():
        _fill(touched, _footprint(actors[i], ego), 1, grid)
    return touched.astype(np.bool_)


def _footprint(box: Actor | Ego, ego: Ego) -> Floats:
    """Return the [4, 2] corners of a box in the ego frame."""
    half = np.array([box.length, box.width]) / 2
    corners = half * np.array([(-1, -1), (1, -1), (1, 1), (-1, 1)])
    turn = box.heading - ego.heading
    dx, dy = box.x - ego.x, box.y - ego.y
    cos, sin = np.cos(ego.heading), np.sin(ego.heading)
    centre = np.array([cos * dx + sin * dy, cos * dy - sin * dx])
    rotation = np.array([(np.cos(turn), np.sin(turn)), (-np.sin(turn), np.cos(turn))])
    return np.asarray(corners @ rotation + centre)


def _fill(labels: Bytes, corners: Floats, value: int, grid: BirdseyeGrid) -> None:
    polygon = fixed_point(grid.cells(corners))
    cv2.fillConvexPoly(labels, polygon, (int(value),), cv2.LINE_8, SUBPIXEL_BITS)
