"""Camera poses and projections, for the pictures that the model sees."""

from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.driving.input_sources import InputSource, Observed
from me2e_compress.errors import EvaluationError
from me2e_compress.runtime.frames import Array

Floats = npt.NDArray[np.float64]


@dataclass(frozen=True)
class LidarToImage(InputSource):
    """The model's ground frame to pixels, camera by camera: [cameras, 4, 4].

    Attributes:
        images: The image input whose pixels they are; empty where there is one.
    """

    name: ClassVar[str] = "lidar2img"
    images: str = ""

    def value(self, seen: Observed) -> Array:
        """Return float32 [cameras, 4, 4]."""
        return _projections(seen, self.images).astype(np.float32)


@dataclass(frozen=True)
class LidarToCamera(InputSource):
    """The model's ground frame to x right, y down, z forward: [cameras, 4, 4].

    Attributes:
        images: The image input whose cameras they are; empty where there is one.
    """

    name: ClassVar[str] = "lidar2cam"
    images: str = ""

    def value(self, seen: Observed) -> Array:
        """Return float64 [cameras, 4, 4]."""
        projections = _projections(seen, self.images)
        found = projections.copy()
        inverse = np.linalg.inv(_intrinsics(projections))
        found[:, :3] = inverse @ projections[:, :3]
        return found


@dataclass(frozen=True)
class Intrinsics(InputSource):
    """Camera frame to pixels, camera by camera: [cameras, 3, 3], or 4 by 4.

    Attributes:
        images: The image input whose pixels they are; empty where there is one.
        homogeneous: Pad to 4 by 4 with a row and a column of the unit matrix.
    """

    name: ClassVar[str] = "intrinsics"
    images: str = ""
    homogeneous: bool = False

    def value(self, seen: Observed) -> Array:
        """Return float64 [cameras, 3, 3], or [cameras, 4, 4]."""
        found = _intrinsics(_projections(seen, self.images))
        if not self.homogeneous:
            return found
        padded = np.tile(np.eye(4), (len(found), 1, 1))
        padded[:, :3, :3] = found
        return padded


def _projections(seen: Observed, images: str) -> Floats:
    """Return [cameras, 4, 4], the model's ground frame to an image input's pixels."""
    there = seen.projections
    if images in there:
        found = there[images]
    elif not images and len(there) == 1:
        (found,) = there.values()
    else:
        raise EvaluationError(
            f"images = {images!r} names no image input; there are {', '.join(there)}"
        )
    return seen.axes.projection(found).astype(np.float64)


def _intrinsics(projections: Floats) -> Floats:
    """Return [cameras, 3, 3], upper triangular, the last row (0, 0, 1).

    The rows of K R are f r1 + c r3, g r2 + d r3 and r3, with orthonormal r: no camera
    here has skew.
    """
    rows, forward = projections[:, :2, :3], projections[:, 2, :3]
    centre = np.einsum("kij,kj->ki", rows, forward)
    focal = np.linalg.norm(rows - centre[..., None] * forward[:, None], axis=2)
    found = np.tile(np.eye(3), (len(projections), 1, 1))
    found[:, 0, 0], found[:, 1, 1] = focal[:, 0], focal[:, 1]
    found[:, :2, 2] = centre
    return found
