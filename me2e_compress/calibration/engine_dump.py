"""Read what an engine answered elsewhere over recorded frames.

A dump is a folder of ``.npz`` keyed by tensor name, one a frame, named as the frame is.
"""

import functools
from collections.abc import Iterator, Mapping
from pathlib import Path

from me2e_compress.base.display import plural
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.dataset import CalibrationSet, load_arrays
from me2e_compress.runtime.frames import Array

# Most frames in memory: some are read again and again.
_CACHED = 8


class EngineDump:
    """What an engine answered, read frame by frame.

    Attributes:
        path: The folder.
        stems: Names of the frames that were answered.
        names: Of the tensors of each frame, in the order of the first.

    Raises:
        FramesError: no such dump, no answers, or a file that cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        if not self.path.exists():
            raise FramesError(f"{self.path}: no such folder")
        self.stems = tuple(sorted(file.stem for file in self.path.glob("*.npz")))
        if not self.stems:
            raise FramesError(
                f"{self.path}: no .npz; JSON of other tools: docs/engine-dumps.md, in"
                " the repository"
            )
        self._at = functools.lru_cache(maxsize=_CACHED)(self._read)
        self.names = tuple(self[0])

    def __len__(self) -> int:
        return len(self.stems)

    def __getitem__(self, index: int) -> Mapping[str, Array]:
        """Read what was answered to one frame."""
        return self._at(index)

    def __iter__(self) -> Iterator[Mapping[str, Array]]:
        """Read the answers in order, one frame in memory at a time."""
        return (self[index] for index in range(len(self)))

    def label(self, index: int) -> str:
        """Return how a message names a frame's answers."""
        return str(self.path / self.stems[index])

    def _read(self, index: int) -> Mapping[str, Array]:
        return load_arrays(self.path / f"{self.stems[index]}.npz")

    def check(self, frames: CalibrationSet) -> None:
        """Check that every frame was answered, and with the same tensors of numbers."""
        # The same frames
        stems = dict.fromkeys(file.stem for file in frames.files)
        if unknown := [stem for stem in self.stems if stem not in stems]:
            raise FramesError(
                f"{self.path}: {unknown[0]} is answered and is no frame of"
                f" {frames.folder}, whose first is {frames.files[0].stem}"
            )
        if missing := [stem for stem in stems if stem not in self.stems]:
            raise FramesError(
                f"{self.path}: {missing[0]} is not answered: answers to"
                f" {plural(len(self), 'frame')}, {frames.folder} has {len(frames)}: the"
                " dump is of other frames"
            )
        # And the same tensors of numbers in each
        for index, tensors in enumerate(self):
            for name in (*self.names, *tensors):
                if (name in tensors) != (name in self.names):
                    label = self.label(0 if name in tensors else index)
                    raise FramesError(
                        f"{label}: {name} is missing; other frames have it"
                    )
            for name, array in tensors.items():
                if array.dtype.kind not in "fiub":
                    raise FramesError(
                        f"{self.label(index)}: {name} is {array.dtype}, which is no"
                        " number; write bfloat16 as float32"
                    )
