"""Write recordings, and the cache of another tool, for tests."""

import json
import struct
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt


def record(
    folder: Path,
    frames: Sequence[Mapping[str, npt.NDArray[np.generic]]],
    scenes: Sequence[int] = (0,),
) -> Path:
    """Write frames and scenes.json into a new folder."""
    folder.mkdir(parents=True, exist_ok=True)
    for index, arrays in enumerate(frames):
        with (folder / f"{index:06d}.npz").open("wb") as stream:
            np.savez(stream, **arrays)  # type: ignore[arg-type]
    (folder / "scenes.json").write_text(json.dumps({"scenes": list(scenes)}))
    return folder


def tensorrt_cache(tensors: Mapping[str, Sequence[float]]) -> str:
    """Write bounds, by tensor, as TensorRT 10 writes its calibration cache."""
    lines = ["TRT-101000-MinMaxCalibration"]
    for name, (low, high) in tensors.items():
        scale = max(-low, high) / 127
        lines.append(f"{name}: {struct.pack('!f', scale).hex()}")
    return "\n".join([*lines, ""])
