"""What calibration found, and for which graph and frames it holds."""

import dataclasses
from pathlib import Path
from typing import Self

import pydantic

from me2e_compress.errors import FramesError
from me2e_compress.runtime.atomic import write_json


@dataclasses.dataclass(frozen=True)
class Ranges:
    """The range of every calibrated tensor.

    Attributes:
        tensors: (smallest, largest) element seen, by tensor name.
        method: how extremes became ranges, e.g. ``max-min``.
        frames: how many frames were seen.
        model: digest of the graph they were measured on.
        source: fingerprint of the frames.
    """

    tensors: dict[str, tuple[float, float]]
    method: str
    frames: int
    model: str
    source: str

    @property
    def dead(self) -> tuple[str, ...]:
        """Name the tensors that were zero in every frame."""
        return tuple(name for name, ends in self.tensors.items() if ends == (0.0, 0.0))

    def save(self, path: Path) -> None:
        """Write JSON, all or nothing."""
        write_json(path, dataclasses.asdict(self), indent=1)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote.

        Raises:
            FramesError: no such file, or not saved ranges.
        """
        if not path.is_file():
            raise FramesError(f"{path}: no such ranges file")
        try:
            found = pydantic.TypeAdapter(cls).validate_json(path.read_bytes())
        except pydantic.ValidationError as error:
            first = error.errors()[0]
            where = ".".join(str(part) for part in first["loc"]) or "file"
            raise FramesError(f"{path}: not ranges: {where}: {first['msg']}") from error
        return found

    def check(
        self,
        *,
        model: str,
        tensors: tuple[str, ...],
        method: str,
        source: str | None = None,
    ) -> None:
        """Refuse ranges of another graph, tensor list, method or recording.

        Args:
            model: digest of the graph that is to be quantized.
            tensors: what it needs a range of.
            method: what was asked for.
            source: fingerprint of the frames at hand; None if there are none.

        Raises:
            FramesError: says what is stale, and what to do.
        """
        again = "calibrate the graph that is being quantized again"
        if self.model != model:
            raise FramesError(
                f"ranges are stale: of graph {self.model[:12]}, not {model[:12]};"
                f" {again}"
            )
        if self.method != method:
            raise FramesError(f"ranges are of method {self.method}, asked for {method}")
        if source is not None and self.source != source:
            raise FramesError(
                f"ranges are stale: of frames {self.source[:12]}, not {source[:12]};"
                f" {again}"
            )
        if missing := [name for name in tensors if name not in self.tensors]:
            raise FramesError(
                f"ranges lack {missing[0]} and {len(missing) - 1} more of"
                f" {len(tensors)} tensors; {again}"
            )
