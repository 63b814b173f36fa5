"""Pictures as files: written beside their place, then moved there."""

import os
from collections.abc import Iterable
from pathlib import Path

import numpy as np
import numpy.typing as npt
from PIL import Image

from me2e_compress.errors import EvaluationError

Bytes = npt.NDArray[np.uint8]

COLOURS = 256


def write_png(path: Path, picture: Bytes) -> None:
    """Write uint8 [H, W, 3] as PNG.

    Raises:
        EvaluationError: The file cannot be written.
    """
    _replace(path, "PNG", [Image.fromarray(picture)], 0)


def write_gif(path: Path, pictures: Iterable[Bytes], frame_us: int) -> None:
    """Write an animation that loops; all frames share one palette.

    Args:
        path: Where.
        pictures: uint8 [H, W, 3], all of one size, at least one.
        frame_us: How long each is shown; GIF rounds to hundredths of a second.

    Raises:
        EvaluationError: There is no picture, or the file cannot be written.
    """
    images = [Image.fromarray(picture) for picture in pictures]
    if not images:
        raise EvaluationError(f"{path}: an animation needs at least one picture")
    palette = _palette(images)
    frames = [
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    ]
    _replace(path, "GIF", frames, max(20, round(frame_us / 10_000) * 10))


def _palette(images: list[Image.Image]) -> Image.Image:
    """The 256 colours of a few frames from the whole animation."""
    chosen = images[:: max(1, len(images) // 6)]
    sheet = np.concatenate([np.asarray(image) for image in chosen])
    return Image.fromarray(sheet).quantize(COLOURS, Image.Quantize.MEDIANCUT)


def _replace(
    path: Path, kind: str, frames: list[Image.Image], duration_ms: int
) -> None:
    partial = path.with_name(f".{path.name}.{os.getpid()}.part")
    try:
        if kind == "GIF":
            frames[0].save(
                partial,
                kind,
                save_all=True,
                append_images=frames[1:],
                duration=duration_ms,
                loop=0,
                optimize=False,
            )
        else:
            frames[0].save(partial, kind)
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        raise EvaluationError(
            f"{path}: the picture cannot be written: {error.strerror or error}"
        ) from error
