"""Where the means of an ablation come from."""

from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.means import load_means, token_means
from me2e_compress.errors import FramesError
from me2e_compress.passes.substitutes import layout_of
from me2e_compress.runtime.frames import Array


def means_of(
    model: ir.Model,
    values: Sequence[ir.Value],
    frames: CalibrationSet | None,
    file: Path | None,
) -> tuple[dict[str, Array], str]:
    """Read means from a file, or measure them on frames.

    Args:
        model: the graph that makes the values.
        values: of its main graph.
        frames: the recording; None if there is none.
        file: an ``.npz`` by value name, which goes before frames; None for frames.

    Returns:
        The means by value name, and where they are from in words.

    Raises:
        FramesError: neither frames nor a file, or they are of another graph.
        PreconditionError: a value has no static shape, or is itself a shape.
    """
    for value in values:
        layout_of(value)
    names = [str(value.name) for value in values]
    if file is not None:
        return load_means(file, names), f"its mean in {file}"
    if frames is None:
        raise FramesError(
            "fill=means needs recorded frames (--frames) or a file (means=FILE.npz):"
            " a mean is never made up"
        )
    return token_means(model, frames, names), f"its mean over {len(frames)} frames"
