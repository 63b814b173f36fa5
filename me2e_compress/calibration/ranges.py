"""Ranges of tensors, with the graph and frames they were measured on."""

import dataclasses
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Literal, Self, TypeAlias

import numpy as np
import pydantic

from me2e_compress.base import documents
from me2e_compress.base.atomic import write_document
from me2e_compress.base.display import join_names, plural
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.observers import OBSERVERS, Observer
from me2e_compress.calibration.statistics import ALL_ZERO, NOT_FINITE, Statistics

# Crest factor (largest magnitude of the range over root mean square) from which a
# tensor is reported: its int8 step then exceeds half its root mean square, so that most
# elements round to 0, 1 or 2 steps.
OUTLIER_CREST = 64

# The largest bound of a range: elements are float32.
LARGEST = float(np.finfo(np.float32).max)

# Method of ranges measured by another tool, on unknown frames
IMPORTED = "imported"


# What an input or output did over a recording: its values differed between frames, were
# the same in all, were zero in all, or had a NaN or infinity.
Activity: TypeAlias = Literal["varies", "constant", "zero", "not finite"]


@dataclasses.dataclass(frozen=True, repr=False)
class Ranges:
    """The range of every calibrated tensor.

    Attributes:
        tensors: (low, high) bounds by tensor name.
        method: observer with options: ``max-min``, ``percentile:99.9``.
        frames: number of frames; 0 for imported ranges.
        model: digest of the graph.
        source: fingerprint of the recording.
        rms: root mean square of tensors over all frames; empty where it is not known.
        scenes: number of scenes; None where it is not known.
        inputs: what each input of the graph did; empty where it is not known.
        outputs: what each output of the graph did; empty where it is not known.
        not_finite: the node that is first to make NaN or infinity, in a sentence; else
            empty, and not written.
    """

    tensors: dict[str, tuple[float, float]]
    method: str
    frames: int
    model: str
    source: str
    rms: dict[str, float] = dataclasses.field(default_factory=dict)
    scenes: int | None = None
    inputs: dict[str, Activity] = dataclasses.field(default_factory=dict)
    outputs: dict[str, Activity] = dataclasses.field(default_factory=dict)
    not_finite: str = ""

    @classmethod
    def of(cls, statistics: Statistics, method: Observer) -> Self:
        """Compute ranges from the statistics of a calibration."""
        lows, highs = method.ranges(statistics)
        bounds = zip(lows.tolist(), highs.tolist(), strict=True)
        return cls(
            dict(zip(statistics.tensors, bounds, strict=True)),
            OBSERVERS.text(method, defaults=True),
            len(statistics.frames),
            statistics.model,
            statistics.source,
            rms=rms_of(statistics),
            scenes=len(statistics.scenes) or None,
            inputs=_activities_of(statistics, statistics.inputs, 0),
            outputs=_activities_of(
                statistics, statistics.outputs, len(statistics.inputs)
            ),
            not_finite=statistics.not_finite,
        )

    @property
    def headline(self) -> str:
        """The number of tensors, the method and the number of frames."""
        return (
            f"{plural(len(self.tensors), 'tensor')}, {self.method},"
            f" {plural(self.frames, 'frame')}"
        )

    @property
    def dead(self) -> tuple[str, ...]:
        """The tensors that were zero in every frame, not those that a method cut."""
        zero = [name for name, bounds in self.tensors.items() if bounds == (0.0, 0.0)]
        return tuple(name for name in zero if not self.rms.get(name))

    @property
    def crests(self) -> dict[str, float]:
        """The largest magnitude of each range over its root mean square, if known."""
        ratios = {}
        for name, root in self.rms.items():
            low, high = self.tensors[name]
            ratios[name] = max(-low, high) / root if root else 0.0
        return ratios

    @property
    def outliers(self) -> dict[str, float]:
        """Crest factors, to three digits, of tensors whose range few elements make."""
        return {
            name: float(f"{crest:.3g}")
            for name, crest in self.crests.items()
            if crest > OUTLIER_CREST
        }

    def save(self, path: Path) -> None:
        """Write JSON atomically."""
        document = dataclasses.asdict(self)
        if not self.not_finite:
            del document["not_finite"]
        write_document(path, document, indent=1)

    @classmethod
    def load(cls, path: Path) -> Self:
        """Read what :meth:`save` wrote; a FramesError if it contradicts itself."""
        if not path.is_file():
            raise FramesError(f"{path}: no such ranges file")
        with documents.reading(path, FramesError, "not ranges"):
            content = documents.read_bytes(path)
            ranges = pydantic.TypeAdapter(cls).validate_json(content)
        # Bounds must be finite and in order.
        for name, (low, high) in ranges.tensors.items():
            if not -LARGEST <= low <= high <= LARGEST:  # NaN too
                raise FramesError(
                    f"{path}: not ranges: {name} has {low:g} to {high:g}; a range is"
                    " two float32 bounds, the lower one first"
                )
        if lie := ranges._why_invalid():
            raise FramesError(f"{path}: not ranges: {lie}")
        return ranges

    def _why_invalid(self) -> str:
        """Return what in a file cannot be true; empty if all can."""
        imported = self.method == IMPORTED
        if self.frames < 1 and not imported:
            return f"{self.method} of {self.frames} frames; give a recording"
        if self.scenes is not None and not 0 < self.scenes <= self.frames:
            return f"{self.scenes} scenes in {self.frames} frames"
        for name, root in self.rms.items():
            if name not in self.tensors:
                return f"the root mean square of {name}, which has no range"
            if not 0 <= root <= LARGEST:  # NaN too
                return f"{name} has a root mean square of {root:g}"
        return ""

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
        named: str | Path = "ranges",
    ) -> None:
        """Check that ranges fit this graph, tensor list, method and recording.

        ``model`` is the digest of the graph to be quantized, ``source`` the fingerprint
        of the frames, None if there are none; the message calls the ranges ``named``.
        Ranges that do not fit are a FramesError that says what to do.
        """
        again = "calibrate the graph that is being quantized again"
        if self.model != model:
            raise FramesError(
                f"{named}: stale: of graph {self.model[:12]}, not {model[:12]}; {again}"
            )
        # Imported ranges pass for any method and recording.
        asked = method
        if not method == self.method == IMPORTED:
            asked = OBSERVERS.text(OBSERVERS.parse(method), defaults=True)
        if self.method not in (asked, IMPORTED):
            raise FramesError(
                f"{named}: of method {self.method}, asked for {asked}; give --method"
            )
        wanted = self.source if source is None else source
        if self.method != IMPORTED and self.source != wanted:
            raise FramesError(
                f"{named}: stale: of frames {self.source[:12]}, not {wanted[:12]};"
                f" {again}"
            )
        # The graph may need tensors that were not measured.
        if missing := [name for name in tensors if name not in self.tensors]:
            if self.method == IMPORTED:
                again = "give the overrides that stand beside it (--overrides)"
            raise FramesError(
                f"{named}: of {len(tensors)} tensors lacks {join_names(missing, 1)};"
                f" {again}"
            )


def rms_of(statistics: Statistics) -> dict[str, float]:
    """Return root mean squares, to four digits; a square may be beyond float32."""
    if not statistics.tensors:
        return {}
    root = np.sqrt(statistics.mean_squares.astype(np.float64).mean(axis=0))
    pairs = zip(statistics.tensors, root.tolist(), strict=True)
    return {name: float(f"{rms:.4g}") for name, rms in pairs if math.isfinite(rms)}


def _activities_of(
    statistics: Statistics, names: Sequence[str], begin: int
) -> dict[str, Activity]:
    """Return what inputs or outputs did, from their checksums from column ``begin``."""
    activities = dict[str, Activity]()
    for name, column in zip(names, statistics.checksums.T[begin:], strict=False):
        if (column == NOT_FINITE).any():
            activities[name] = "not finite"
        elif (column != column[0]).any():
            activities[name] = "varies"
        else:
            activities[name] = "zero" if column[0] == ALL_ZERO else "constant"
    return activities
