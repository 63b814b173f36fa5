"""Images for models that nobody trained: smooth, with edges, other by seed."""

import numpy as np
from numpy.typing import NDArray

COARSE = 8
"""Cells a side of the coarsest noise."""


def smooth_images(
    shape: tuple[int, ...], count: int, seed: int
) -> list[NDArray[np.float32]]:
    """Draw images of about unit variance: float32 [1, C, H, W] each.

    Noise at three scales, and a bright rectangle: neighbours are alike as in photos,
    so that what a calibration sees is no white noise.
    """
    drawn = np.random.default_rng(seed)
    return [_image(shape, drawn) for _ in range(count)]


def _image(shape: tuple[int, ...], drawn: np.random.Generator) -> NDArray[np.float32]:
    batch, channels, height, width = shape
    image: NDArray[np.float64] = np.zeros(shape)
    for cells in (COARSE, 4 * COARSE, 16 * COARSE):
        noise = drawn.normal(size=(batch, channels, cells, cells))
        rows = np.arange(height) * cells // height
        columns = np.arange(width) * cells // width
        image += noise[:, :, rows][:, :, :, columns] * COARSE / cells
    top, left = drawn.integers(0, height // 2), drawn.integers(0, width // 2)
    image[:, :, top : top + height // 3, left : left + width // 3] += 1.5
    scaled: NDArray[np.float32] = (image / image.std()).astype(np.float32)
    return scaled
