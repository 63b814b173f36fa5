"""Six camera images as one JPEG."""

from collections.abc import Sequence
from typing import Any

import cv2
import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from me2e_compress.simulator.cameras.renderer import Cameras
from me2e_compress.simulator.scene import Scene

Bytes = npt.NDArray[np.uint8]

QUALITY = (
    cv2.IMWRITE_JPEG_QUALITY,
    95,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR,
    cv2.IMWRITE_JPEG_SAMPLING_FACTOR_444,
)
"""Full colour resolution: a red lamp far away is two pixels wide."""


def encode(images: Bytes) -> Bytes:
    """Encode uint8 [K, H, W, 3] RGB images, stacked vertically, as one JPEG."""
    stacked = images.reshape(-1, *images.shape[2:])
    bgr = cv2.cvtColor(stacked, cv2.COLOR_RGB2BGR)
    _, content = cv2.imencode(".jpg", bgr, QUALITY)
    return np.asarray(content, np.uint8)


def decode(content: Bytes, cameras: int = 6) -> Bytes:
    """Return the uint8 [K, H, W, 3] RGB images of `encode`.

    Args:
        content: uint8 [bytes].
        cameras: K.

    Raises:
        EvaluationError: It is not a JPEG.
    """
    stacked = cv2.imdecode(content, cv2.IMREAD_COLOR)
    if stacked is None:
        raise EvaluationError(f"a picture of {len(content)} bytes is not a JPEG")
    rgb = np.asarray(cv2.cvtColor(stacked, cv2.COLOR_BGR2RGB), np.uint8)
    return rgb.reshape(cameras, -1, *rgb.shape[1:])


def pictures(cameras: Cameras, scenes: Sequence[Scene]) -> dict[str, npt.NDArray[Any]]:
    """Render scenes.

    Returns:
        ``jpeg`` uint8 [bytes] and ``jpeg_offsets`` int64 [T + 1]: the picture of
        scene i is ``jpeg[jpeg_offsets[i]:jpeg_offsets[i + 1]]``.
    """
    contents = [encode(cameras.render(scene)) for scene in scenes]
    offsets = np.cumsum([0, *(len(content) for content in contents)])
    return {
        "jpeg": np.concatenate(contents),
        "jpeg_offsets": offsets.astype(np.int64),
    }
