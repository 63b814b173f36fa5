"""Ranges of tensors, with the graph and frames they were measured on."""

import dataclasses
from pathlib import Path
from typing import Self

import numpy as np
import pydantic

from me2e_compress.calibration.observers import OBSERVERS, Observer
from me2e_compress.calibration.statistics import Statistics
from me2e_compress.display import Displayed, Table, counted, table
from me2e_compress.errors import FramesError
from me2e_compress.registry import documents
from me2e_compress.runtime.atomic import write_document

OUTLIER_CREST = 64
"""Crest factor (largest magnitude over root mean square) from which a tensor is
reported: its int8 step then exceeds half its root mean square, so that most elements
round to 0, 1 or 2 steps."""

LARGEST = float(np.finfo(np.float32).max)
"""The largest bound of a range: elements are float32."""

IMPORTED = "imported"
"""Method of ranges measured by another tool, on unknown frames."""


@dataclasses.dataclass(frozen=True, repr=False)
class Ranges(Displayed):
    """The range of every calibrated tensor.

    Attributes:
        tensors: (low, high) bounds by tensor name.
        method: observer with options: ``max-min``, ``percentile:99.9``.
        frames: number of frames.
        model: digest of the graph.
        source: fingerprint of the recording.
        outliers: crest factors; of tensors whose range is due to few elements, see
            :data:`OUTLIER_CREST`.
        calibrator: TensorRT's; of an imported cache, else empty.
    """

    tensors: dict[str, tuple[float, float]]
    method: str
    frames: int
    model: str
    source: str
    outliers: dict[str, float] = dataclasses.field(default_factory=dict)
    calibrator: str = ""

    @classmethod
    def of(cls, seen: Statistics, method: Observer) -> Self:
        """Compute ranges from the statistics of a calibration."""
        lows, highs = method.ranges(seen)
        bounds = zip(lows.tolist(), highs.tolist(), strict=True)
        return cls(
            dict(zip(seen.tensors, bounds, strict=True)),
            OBSERVERS.text(method, defaults=True),
            len(seen.frames),
            seen.model,
            seen.source,
            _outliers(seen),
        )

    @property
    def headline(self) -> str:
        """The number of tensors, the method and the number of frames."""
        return (
            f"{counted(len(self.tensors), 'tensor')}, {self.method},"
            f" {counted(self.frames, 'frame')}"
        )

    def tables(self) -> tuple[Table, ...]:
        """Return a table of the bounds of each tensor."""
        rows = [
            (name, f"{low:.4g}", f"{high:.4g}")
            for name, (low, high) in self.tensors.items()
        ]
        return (table("Ranges", ("tensor", "low", "high"), rows),)

    @property
    def dead(self) -> tuple[str, ...]:
        """The tensors that were zero in every frame."""
        return tuple(name for name, each in self.tensors.items() if each == (0.0, 0.0))

    def save(self, path: Path) -> None:
        """Write JSON atomically."""
        write_document(path, dataclasses.asdict(self), indent=1)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote, and check the bounds."""
        if not path.is_file():
            raise FramesError(f"{path}: no such ranges file")
        with documents.reading(path, FramesError, "not ranges"):
            content = documents.content(path)
            found = pydantic.TypeAdapter(cls).validate_json(content)
        # Bounds must be finite and in order.
        for name, (low, high) in found.tensors.items():
            if not -LARGEST <= low <= high <= LARGEST:  # NaN too
                raise FramesError(
                    f"{path}: not ranges: {name} has {low:g} to {high:g}; a range is"
                    " two float32 bounds, the lower one first"
                )
        return found

    def hold_for(self, model: str, tensors: tuple[str, ...], method: str) -> bool:
        """Return whether they fit this graph and method and have all these tensors."""
        asked = OBSERVERS.text(OBSERVERS.parse(method), defaults=True)
        known = self.model == model and self.method == asked
        return known and all(name in self.tensors for name in tensors)

    def check(
        self,
        *,
        model: str,
        tensors: tuple[str, ...],
        method: str,
        source: str | None = None,
    ) -> None:
        """Check that ranges fit this graph, tensor list, method and recording.

        ``model`` is the digest of the graph to be quantized, ``source`` the fingerprint
        of the frames, None if there are none. Imported ranges fit any method and
        frames.

        Raises:
            FramesError: something is stale; the message says what to do.
            RecipeError: no such method.
        """
        again = "calibrate the graph that is being quantized again"
        if self.model != model:
            raise FramesError(
                f"ranges are stale: of graph {self.model[:12]}, not {model[:12]};"
                f" {again}"
            )
        # Imported ranges pass for any method and recording.
        asked = method
        if not method == self.method == IMPORTED:
            asked = OBSERVERS.text(OBSERVERS.parse(method), defaults=True)
        if self.method not in (asked, IMPORTED):
            raise FramesError(f"ranges are of method {self.method}, asked for {asked}")
        wanted = self.source if source is None else source
        if self.method != IMPORTED and self.source != wanted:
            raise FramesError(
                f"ranges are stale: of frames {self.source[:12]}, not {wanted[:12]};"
                f" {again}"
            )
        # The graph may need tensors that were not measured.
        if missing := [name for name in tensors if name not in self.tensors]:
            raise FramesError(
                f"ranges lack {missing[0]} and {len(missing) - 1} more of"
                f" {len(tensors)} tensors; {again}"
            )


def _outliers(seen: Statistics) -> dict[str, float]:
    """Return the crest factors above the limit, rounded to three digits."""
    if not seen.tensors:
        return {}
    root = np.sqrt(seen.mean_squares.astype(np.float64).mean(axis=0))
    crest = seen.reach / np.where(root > 0, root, np.inf)
    return {
        name: float(f"{factor:.3g}")
        for name, factor in zip(seen.tensors, crest.tolist(), strict=True)
        if factor > OUTLIER_CREST
    }
