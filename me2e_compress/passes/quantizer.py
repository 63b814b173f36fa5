"""Passes that read the ranges of tensors, from frames or from a file."""

import abc
import dataclasses
from pathlib import Path
from typing import ClassVar

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.passes.base import Context, Pass


@dataclasses.dataclass(frozen=True)
class Quantizer(Pass):
    """A pass that calibrates tensors; it has the options ``ranges`` and ``method``.

    ``ranges`` is a file that replaces frames. The class attribute ``takes_float`` is
    True of a pass that quantizes a float graph to int8.
    """

    takes_float: ClassVar[bool] = False

    @property
    @abc.abstractmethod
    def method_of_ranges(self) -> str:
        """The calibration method by which ranges are read from frames."""

    @abc.abstractmethod
    def ranged_tensors(self, model: ir.Model, context: Context) -> tuple[str, ...]:
        """Return the names of the tensors it calibrates; shapes must be inferred."""

    def read_ranges(
        self,
        model: ir.Model,
        tensors: tuple[str, ...],
        context: Context,
        saved: Path | None,
    ) -> Ranges:
        """Load the ranges of tensors from ``saved``, or measure them on the frames.

        Raises:
            FramesError: neither frames nor a file, or they are of another graph.
        """
        # Saved ranges must belong to this graph and these frames
        digest, method = graph.digest(model), self.method_of_ranges
        if saved is not None:
            ranges, frames = Ranges.load(saved), context.frames
            source = None if frames is None else frames.fingerprint
            ranges.check(
                model=digest, tensors=tensors, method=method, source=source, named=saved
            )
            return ranges
        if context.frames is None:
            raise FramesError(
                f"{self.name} needs recorded frames (--frames) or saved ranges"
                " (--ranges): int8 ranges are never made up"
            )
        # Measure only what an earlier run has not measured
        known = context.measured.get(self.name)
        if known is None or not known.hold_for(digest, tensors, method):
            calibrator = Calibrator(method, provider=context.provider)
            known = calibrator.run(model, tensors, context.frames)
            context.measured[self.name] = known
        return known


def quantizes_float(current: Pass) -> bool:
    """Return whether a pass quantizes a float graph to int8."""
    return isinstance(current, Quantizer) and current.takes_float
