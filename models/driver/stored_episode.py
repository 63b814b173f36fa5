"""One episode of a collection, read from its file."""

from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any
from zipfile import BadZipFile

import numpy as np
import numpy.typing as npt

from me2e_compress.base.errors import EvaluationError
from models.driver.episodes import GRID, decode
from models.driver.errors import TrainingError
from models.driver.network.config import CAMERAS, STEPS

Array = npt.NDArray[Any]
Bytes = npt.NDArray[np.uint8]

KEPT: Mapping[str, tuple[int, ...]] = {
    "time_us": (),
    "pose": (3,),
    "can_bus": (18,),
    "command": (),
    "rest_s": (),
    "plan": (STEPS, 2),
    "plan_alone": (STEPS, 2),
    "path": (25, 2),
    "path_attributes": (25, 4),
    "lateral_m": (),
    "agents": (24, 10),
    "futures": (24, STEPS, 2),
    "signals": (4, 8),
    "ground": (GRID.rows, GRID.columns),
    "occupancy": (STEPS, GRID.rows * GRID.columns // 8),
    "known_steps": (),
}
"""Arrays of an episode that training reads, and the shape of a sample in each."""


@dataclass(frozen=True, eq=False)
class Stored:
    """An episode of T samples.

    Attributes:
        arrays: those of `KEPT`, each [T, ...].
        pictures: [T] of six camera images, still compressed: see `decode`.
    """

    arrays: dict[str, Array]
    pictures: list[Bytes]


def read(file: Path, image_size: tuple[int, int]) -> Stored:
    """Read an episode.

    Args:
        file: the ``.npz``.
        image_size: rows and columns of a camera that the model sees.

    Raises:
        TrainingError: it is not an episode, or its cameras are laid out otherwise.
    """
    arrays = _arrays(file, (*KEPT, "jpeg_offsets", "jpeg"))
    offsets, data = arrays.pop("jpeg_offsets"), arrays.pop("jpeg")
    pictures = [data[begin:end].copy() for begin, end in pairwise(offsets)]
    for name, shape in KEPT.items():
        if not pictures or arrays[name].shape != (len(pictures), *shape):
            raise TrainingError(
                f"{file}: not an episode: {name} is {list(arrays[name].shape)}, with "
                f"{len(pictures)} pictures it must be {[len(pictures), *shape]}"
            )
    try:
        found = decode(pictures[0]).shape
    except (EvaluationError, ValueError) as error:
        raise TrainingError(f"{file}: not an episode: {error}") from error
    if found != (CAMERAS, *image_size, 3):
        raise TrainingError(
            f"{file}: its cameras have {found[1]} x {found[2]} pixels, the model sees "
            f"{image_size[0]} x {image_size[1]}: collect again"
        )
    return Stored(arrays, pictures)


def samples_in(file: Path) -> int:
    """Return how many samples an episode holds.

    Raises:
        TrainingError: it is not an episode.
    """
    return int(_arrays(file, ("time_us",))["time_us"].size)


def _arrays(file: Path, names: tuple[str, ...]) -> dict[str, Array]:
    """Read arrays of a file, which need not be an episode."""
    try:
        with file.open("rb") as source:
            content = np.load(source)
            if not isinstance(content, np.lib.npyio.NpzFile):
                raise TrainingError(f"{file}: not an episode: it is a single array")
            missing = [name for name in names if name not in content]
            if missing:
                raise TrainingError(f"{file}: not an episode: it has no {missing[0]}")
            return {name: content[name] for name in names}
    except (OSError, EOFError, ValueError, BadZipFile) as error:
        first = str(error).splitlines()[0]
        raise TrainingError(f"{file}: not an episode: {first}") from error
