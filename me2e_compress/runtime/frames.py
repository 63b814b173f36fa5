"""Frames: the inputs of a model at one moment."""

import dataclasses
from collections.abc import Iterator
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt

Array: TypeAlias = npt.NDArray[np.generic]


@dataclasses.dataclass(frozen=True, repr=False)
class Frame:
    """The inputs of one moment.

    Attributes:
        index: position in the recording, from 0.
        starts_scene: True where a new scene begins: recurrent state is reset here.
        arrays: one array for every input, by input name; recurrent ones may be missing.
        place: number of its scene among those that its source tried; some give no
            frame.
    """

    index: int
    starts_scene: bool
    arrays: dict[str, Array]
    place: int = 0

    def __repr__(self) -> str:
        """Show the index and the shapes, not the arrays."""
        shapes = (f"{name} {list(array.shape)}" for name, array in self.arrays.items())
        starts = ", starts a scene" if self.starts_scene else ""
        return f"<Frame: {self.index}{starts}; {', '.join(shapes)}>"


class Frames(Protocol):
    """A finite recording that can be read again and again."""

    def __len__(self) -> int:
        """Count the frames."""
        ...

    def __iter__(self) -> Iterator[Frame]:
        """Read the frames in order, one in memory at a time."""
        ...
