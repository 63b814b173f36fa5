"""The ground in all six cameras: rows of the texture, sampled anew each frame.

A camera without pitch and roll sees, in each of its rows, a straight segment of the
ground at constant depth. So one row of an image is a point and a step in the ego frame;
both turn and move with the ego, and the pixels of all rows of all cameras are one outer
product. Rows far away are short in the image and long on the ground: they are sampled
several times, which keeps distant lines from flickering.
"""

from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.simulator.camera_rig import (
    CAMERA_HEIGHT_M,
    CameraRig,
)
from me2e_compress.simulator.cameras.texture import (
    LEVELS,
    RESOLUTION_M,
    GroundTexture,
)
from me2e_compress.simulator.scene import Ego

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float64]
Floats32 = npt.NDArray[np.float32]

FARTHEST_M = 400.0
"""Depth of the last row before the horizon, at most."""
SKY_M = 4000.0
"""The sky counts as this far away."""
TAPS = ((0.0, 1), (10.0, 4))
"""From these depths (metres) on, a row is the mean of this many samples."""
BLUR = 0.5
"""A mip level is chosen whose texel is this part of a sample's length on the ground:
less shimmers, more blurs."""


@dataclass(frozen=True, eq=False)
class RowGroup:
    """Rows of the six images that are sampled alike, sorted by mip level.

    Attributes:
        rows: [R] index into the rows of the stacked images [6 * H].
        origins: [T, R, 2] ground point left of the first column, metres in the ego
            frame, one for each of T samples of a row.
        steps: [T, R, 2] metres from one column to the next.
        levels: [R] mip level.
        blocks: (level, first, last) slices of the rows.
        coordinates: Two [R, T, W], working memory, overwritten in every frame.
        samples: [R, T, W, 4], likewise.
    """

    rows: npt.NDArray[np.intp]
    origins: Floats
    steps: Floats
    levels: npt.NDArray[np.intp]
    blocks: tuple[tuple[int, int, int], ...]
    coordinates: tuple[Floats32, Floats32]
    samples: Bytes


@dataclass(frozen=True, eq=False)
class GroundSampler:
    """Draws the ground of a rig from a texture, on one thread at a time."""

    rig: CameraRig

    def paint(self, images: Bytes, texture: GroundTexture, ego: Ego) -> None:
        """Fill the ground rows of uint8 [6, H, W, 3]."""
        stacked = images.reshape(-1, *images.shape[2:])
        for group in self._groups:
            u, v = self._coordinates(group, texture, ego)
            taps = group.samples
            # sample every row from its own mip level, then average
            for level, first, last in group.blocks:
                cv2.remap(
                    texture.levels[level],
                    u[first:last].reshape(-1, self.rig.width),
                    v[first:last].reshape(-1, self.rig.width),
                    cv2.INTER_LINEAR,
                    dst=taps[first:last].reshape(-1, *taps.shape[2:]),
                    borderMode=cv2.BORDER_REPLICATE,
                )
            samples: list[Bytes] = list(taps.swapaxes(0, 1))
            stacked[group.rows] = cv2.cvtColor(_mean(samples), cv2.COLOR_RGBA2RGB)

    def label(self, labels: Bytes, texture: GroundTexture, ego: Ego) -> None:
        """Fill the ground rows of class images uint8 [6, H, W]."""
        u, v = self._coordinates(self._label_rows, texture, ego)
        labels.reshape(-1, labels.shape[2])[self._label_rows.rows] = cv2.remap(
            texture.classes,
            u[:, 0],
            v[:, 0],
            cv2.INTER_NEAREST,
            borderMode=cv2.BORDER_REPLICATE,
        )

    @cached_property
    def places(self) -> Floats:
        """[6, H, W, 2] ground points of all pixels, ego frame; sky far off."""
        depth = np.minimum(row_depths(self.rig, 1)[0], SKY_M)[..., None, None]
        column = np.arange(self.rig.width) + 0.5 - self.rig.centre_px[0]
        tangent = (column / self.rig.focals_px[:, None])[:, None, :, None]
        right, forward = (self.rig.rotations[:, i, None, None, :2] for i in (0, 2))
        position = self.rig.positions[:, None, None, :2]
        return np.asarray(position + depth * (forward + tangent * right))

    @cached_property
    def distances_m(self) -> Floats:
        """[6, H, W] along the ground from the camera to each pixel; `SKY_M` for sky."""
        offset = self.places - self.rig.positions[:, None, None, :2]
        return np.asarray(np.hypot(offset[..., 0], offset[..., 1]))

    def _coordinates(
        self, group: RowGroup, texture: GroundTexture, ego: Ego
    ) -> tuple[Floats32, Floats32]:
        """Return [R, T, W] texture columns and rows, each on its own mip level."""
        cos, sin = np.cos(ego.heading), np.sin(ego.heading)
        # ego frame to metres right and down from the texture's corner: rows run south
        rotation = np.array([[cos, -sin], [-sin, -cos]])
        corner = np.array([ego.x - texture.west_m, texture.north_m - ego.y])
        scale = 1.0 / (RESOLUTION_M * 2.0**group.levels)
        start = (group.origins @ rotation.T + corner) * scale[:, None] - 0.5
        step = (group.steps @ rotation.T) * scale[:, None]
        # [R, T, 2] as the pixels lie
        start32, step32 = (e.astype(np.float32).swapaxes(0, 1) for e in (start, step))
        column = np.arange(self.rig.width, dtype=np.float32) + np.float32(0.5)
        for i, pixels in enumerate(group.coordinates):
            np.multiply(step32[..., i, None], column, out=pixels)
            pixels += start32[..., i, None]
        return group.coordinates

    @cached_property
    def _groups(self) -> tuple[RowGroup, ...]:
        depths = row_depths(self.rig, 1)[0]
        limits = [*(depth for depth, _ in TAPS), np.inf]
        groups = list[RowGroup]()
        for (_, taps), low, high in zip(TAPS, limits[:-1], limits[1:], strict=True):
            camera, row = np.nonzero((depths >= low) & (depths < high))
            if len(row):
                groups.append(self._group(camera, row, taps))
        return tuple(groups)

    @cached_property
    def _label_rows(self) -> RowGroup:
        camera, row = np.nonzero(np.isfinite(row_depths(self.rig, 1)[0]))
        group = self._group(camera, row, taps=1)
        return replace(group, levels=np.zeros_like(group.levels))

    def _group(
        self, camera: npt.NDArray[np.intp], row: npt.NDArray[np.intp], taps: int
    ) -> RowGroup:
        # rows sorted by mip level, so that each level is one slice
        levels = self._levels(camera, row, taps)
        order = np.argsort(levels, kind="stable")
        camera, row, levels = camera[order], row[order], levels[order]
        # start and step of each row on the ground
        depth = row_depths(self.rig, taps)[:, camera, row][..., None]
        right = self.rig.rotations[camera, 0, :2]
        forward = self.rig.rotations[camera, 2, :2]
        steps = depth / self.rig.focals_px[camera, None] * right
        centre = self.rig.positions[camera, :2] + depth * forward
        # slices of equal level
        found, first = np.unique(levels, return_index=True)
        last = [*first[1:].tolist(), len(levels)]
        shape = (len(levels), taps, self.rig.width)
        return RowGroup(
            rows=camera * self.rig.height + row,
            origins=centre - steps * self.rig.centre_px[0],
            steps=steps,
            levels=levels,
            blocks=tuple(zip(found.tolist(), first.tolist(), last, strict=True)),
            coordinates=(np.empty(shape, np.float32), np.empty(shape, np.float32)),
            samples=np.empty((*shape, 4), np.uint8),
        )

    def _levels(
        self, camera: npt.NDArray[np.intp], row: npt.NDArray[np.intp], taps: int
    ) -> npt.NDArray[np.intp]:
        """Return the mip level at which neither columns nor samples skip texels."""
        depth = row_depths(self.rig, 1)[0, camera, row]
        across = depth / self.rig.focals_px[camera]
        along = across * depth / CAMERA_HEIGHT_M / taps
        texels = np.maximum(across, BLUR * along) / RESOLUTION_M
        return np.asarray(np.clip(np.log2(texels).astype(np.intp), 0, LEVELS - 1))


def row_depths(rig: CameraRig, taps: int) -> Floats:
    """Return [T, 6, H], the ground's depth in T samples of each row; inf for the sky.

    A row belongs to the ground if its centre does.
    """
    row = np.arange(rig.height)
    inside = (np.arange(taps) + 0.5) / taps
    below = row + inside[:, None] - rig.centre_px[1]
    ground = (row + 0.5 > rig.centre_px[1])[None, None, :]
    nearest = CAMERA_HEIGHT_M * rig.focals_px[:, None]
    depth = nearest / np.maximum(below[:, None, :], nearest / FARTHEST_M)
    return np.where(ground, depth, np.inf)


def _mean(taps: list[Bytes]) -> Bytes:
    """Average 1, 2 or 4 images, pair by pair."""
    while len(taps) > 1:
        taps = [
            np.asarray(cv2.addWeighted(a, 0.5, b, 0.5, 0.0), np.uint8)
            for a, b in zip(taps[::2], taps[1::2], strict=True)
        ]
    return taps[0]
