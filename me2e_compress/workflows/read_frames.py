"""Read the frames of a compression, and keep some to measure its loss on."""

from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.stack_frames import recording_of
from me2e_compress.passes import Pass
from me2e_compress.runtime.providers import Provider
from me2e_compress.workflows.compress_fidelity import SplitFrames
from me2e_compress.zoo.shipped import sample_frames


def read_frames(
    source: Path, loaded: ir.Model, folder: str | Path | None, provider: Provider
) -> tuple[CalibrationSet | None, CalibrationSet | None]:
    """Open and check the recording, or the frames that ship with the model."""
    if folder is not None:
        recording = recording_of(source, folder, provider)
        recording.check(loaded)
        return recording, None
    shipped = sample_frames(source)
    return None, None if shipped is None else CalibrationSet(shipped)


def split_frames(
    recording: CalibrationSet | None,
    samples: CalibrationSet | None,
    passes: Sequence[Pass],
    measured: int,
) -> SplitFrames:
    """Keep up to a number of frames for the measurement, where a pass is lossy."""
    lossy = not all(each.exact for each in passes)
    saved = any(each.reads_ranges and not each.needs_frames for each in passes)
    return SplitFrames.of(recording, samples, measured if lossy else 0, saved=saved)
