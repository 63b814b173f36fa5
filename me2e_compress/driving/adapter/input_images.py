"""Convert camera pictures to the images that a graph takes."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.adapter.image_inputs import (
    CAMERA_NAMES,
    Crop,
    ImageInput,
    ImageNormalization,
    ImagePort,
)
from me2e_compress.errors import EvaluationError
from me2e_compress.extras import explained
from me2e_compress.runtime.frames import Array

Bytes = npt.NDArray[np.uint8]
Floats = npt.NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class InputImages:
    """Makes one image input from the cameras' pictures.

    ``rendered`` holds their rows and columns; ``normalization`` None leaves bytes.
    """

    table: ImageInput
    port: ImagePort
    rendered: tuple[int, int]
    normalization: ImageNormalization | None

    @property
    def indices(self) -> tuple[int, ...]:
        """Indices of the cameras among the six."""
        return tuple(map(CAMERA_NAMES.index, self.table.cameras))

    @property
    def windows(self) -> tuple[Crop, ...]:
        """Left, top, right and bottom of each crop, in rendered pixels."""
        rows, columns = self.rendered
        if (crops := self.table.crops) is None:
            return ((0, 0, columns, rows),) * len(self.indices)
        # crops count pixels of the camera's own size
        full_rows, full_columns = self.table.camera_size or self.rendered
        across, down = columns / full_columns, rows / full_rows
        return tuple(
            (
                round(left * across),
                round(top * down),
                round(right * across),
                round(bottom * down),
            )
            for left, top, right, bottom in crops
        )

    def check(self, name: str) -> None:
        """Check that no crop is empty, and that crops to stitch have one height."""
        rows, columns = self.rendered
        said = f"input {name}: of cameras rendered in {rows} x {columns}"
        if not all(a < c and b < d for a, b, c, d in self.windows):
            raise EvaluationError(f"{said}, a crop has no pixel")
        heights = sorted({bottom - top for _, top, _, bottom in self.windows})
        if self.table.stitch and len(heights) > 1:
            raise EvaluationError(
                f"{said}, the crops that are stitched have {heights[0]} and"
                f" {heights[-1]} rows: choose crops or a rendered size that divide"
            )

    @property
    def size(self) -> tuple[int, int]:
        """Rows and columns of a picture, without padding."""
        return self.table.size or self.port.size

    def apply(self, images: Bytes) -> Array:
        """Return the input in the graph's layout, from uint8 RGB [6, H, W, 3]."""
        taken = self._taken(images)
        if self.normalization is None:
            planes: Array = np.moveaxis(taken, -1, 1)
            planes = planes[:, ::-1] if self.table.order == "bgr" else planes
        else:
            planes = self.normalization.apply(taken)[0]
        return _laid_out(_padded(planes, self.port.size), self.port.layout)

    def projections(
        self, lidar2img: npt.NDArray[np.float32]
    ) -> npt.NDArray[np.float32]:
        """Convert [6, 4, 4] to rendered pixels into [cameras, 4, 4] to this input's."""
        chosen = lidar2img[list(self.indices)]
        moves = np.stack([self._pixel_move(at) for at in range(len(self.windows))])
        if np.array_equal(moves, np.broadcast_to(np.eye(4), moves.shape)):
            return chosen
        return np.asarray(moves @ chosen, np.float32)

    def _pixel_move(self, at: int) -> npt.NDArray[np.float64]:
        """Return [4, 4], rendered pixels of a camera to those of this input."""
        widths = [right - left for left, _, right, _ in self.windows]
        left, top, right, bottom = self.windows[at]
        before, width = 0, right - left
        if self.table.stitch:
            before, width = sum(widths[:at]), sum(widths)
        across, down = self.size[1] / width, self.size[0] / (bottom - top)
        move = np.diag([across, down, 1.0, 1.0])
        move[0, 2], move[1, 2] = across * (before - left), -down * top
        return move

    def _taken(self, images: Bytes) -> Bytes:
        """Return uint8 RGB [pictures, h, w, 3]."""
        rows, columns = self.rendered
        # pictures taken as they are need no copy
        whole = all(each == (0, 0, columns, rows) for each in self.windows)
        if whole and self.size == self.rendered and not self.table.stitch:
            every = self.indices == tuple(range(len(images)))
            return images if every else images[list(self.indices)]
        parts = [
            images[index, top:bottom, left:right]
            for index, (left, top, right, bottom) in zip(
                self.indices, self.windows, strict=True
            )
        ]
        if self.table.stitch:
            parts = [np.concatenate(parts, axis=1)]
        return np.stack([_resized(part, self.size) for part in parts])


def _resized(picture: Bytes, size: tuple[int, int]) -> Bytes:
    """Resize a picture [rows, columns, 3] bilinearly, by pixel centres."""
    if picture.shape[:2] == size:
        return picture
    try:
        import cv2
    except ImportError as error:
        raise explained(error) from error
    made = cv2.resize(picture, size[::-1], interpolation=cv2.INTER_LINEAR)
    return np.asarray(made, np.uint8)


def _padded(planes: Array, size: Sequence[int]) -> Array:
    """Pad [n, c, rows, columns] with zeros below and to the right."""
    if planes.shape[-2:] == tuple(size):
        return planes
    padded = np.zeros((*planes.shape[:2], *size), planes.dtype)
    padded[..., : planes.shape[2], : planes.shape[3]] = planes
    return padded


def _laid_out(planes: Array, layout: str) -> Array:
    """Return [n, c, h, w] in a layout, contiguous."""
    if "n" not in layout:
        planes = planes[0]
    letters = "nchw" if "n" in layout else "chw"
    order = [letters.index(letter) for letter in layout if letter != "b"]
    turned = planes.transpose(order)
    if "b" in layout:
        turned = np.expand_dims(turned, layout.index("b"))
    return np.ascontiguousarray(turned)
