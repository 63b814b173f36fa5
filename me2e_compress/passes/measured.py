"""Where a pass gets its ranges: from a file, or from the frames."""

from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import FramesError
from me2e_compress.passes.base import Context


def measured_ranges(
    name: str,
    model: ir.Model,
    tensors: tuple[str, ...],
    context: Context,
    *,
    method: str,
    saved: Path | None,
) -> Ranges:
    """Read the ranges of some tensors from a file, or measure them on the frames.

    Args:
        name: of the pass that asks.
        model: the graph that is quantized.
        tensors: what it needs a range of.
        context: holds the frames.
        method: how ranges are read from the frames.
        saved: file of saved ranges; None to measure.

    Raises:
        FramesError: neither frames nor a file, or they are of another graph.
        RecipeError: no such method.
    """
    frames = context.frames
    if saved is not None:
        found = Ranges.load(saved)
        found.check(
            model=graph.digest(model),
            tensors=tensors,
            method=method,
            source=None if frames is None else frames.fingerprint,
        )
        return found
    if frames is None:
        raise FramesError(
            f"{name} needs recorded frames (--frames) or saved ranges (--ranges): int8"
            " ranges are never made up"
        )
    return Calibrator(method).run(model, tensors, frames)
