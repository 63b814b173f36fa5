"""Where a model to measure on lies; apart from what makes it, which needs torch."""

import dataclasses
from pathlib import Path


@dataclasses.dataclass(frozen=True)
class Subject:
    """One model to measure on.

    Attributes:
        name: one of :data:`benchmarks.subjects.subjects.SUBJECTS`.
        folder: holds everything of it.
    """

    name: str
    folder: Path

    @property
    def source(self) -> Path:
        """The model as it was exported."""
        return self.folder / "source.onnx"

    @property
    def model(self) -> Path:
        """The model after the exact passes."""
        return self.folder / "model.onnx"

    @property
    def frames(self) -> Path:
        """Frames to calibrate on."""
        return self.folder / "frames"

    @property
    def held_out(self) -> Path:
        """Frames of another seed, to compare on."""
        return self.folder / "held-out"

    @property
    def map(self) -> Path:
        """The module map."""
        return self.folder / "map.toml"


def at(folder: Path) -> Subject:
    """Find what :func:`benchmarks.subjects.subjects.make` wrote."""
    return Subject(folder.name, folder)
