"""Exchange ranges with other tools: TensorRT's cache, onnxruntime's table.

Both store one number per tensor, so imported ranges are symmetric: [-reach, reach].
"""

import dataclasses
import re
import struct
import tempfile
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import onnx_ir as ir
from onnxruntime.quantization.calibrate import TensorData
from onnxruntime.quantization.quant_utils import write_calibration_table

from me2e_compress.calibration.observers import QUANT_MAX, MaxMin, scale_of
from me2e_compress.calibration.ranges import IMPORTED, LARGEST, Ranges
from me2e_compress.display import counted
from me2e_compress.errors import FramesError
from me2e_compress.graph import digest, provenance
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_bytes

TABLE_FILES = ("calibration.flatbuffers", "calibration.json", "calibration.cache")
"""Files of an onnxruntime table."""

_MIN_MAX, _ENTROPY = "MinMaxCalibration", "EntropyCalibration2"
_HEAD = re.compile(r"TRT-\d+-(\w+)")

_LEAST = 0.5
"""Least share of the needed tensors that a cache of this graph has."""

_VERSION = "TRT-101000"
"""Version in the head of a written cache; TensorRT 10 reads caches of this form."""


def write_tensorrt_cache(ranges: Ranges, path: Path) -> None:
    """Write a TensorRT calibration cache with a line ``name: scale`` for every tensor.

    The scale, reach / 127, is a float32 in big-endian hexadecimal. The head names the
    calibrator: that of an imported cache, if it is known.
    """
    extremes = ranges.method in (MaxMin.name, IMPORTED)
    kind = ranges.calibrator or (_MIN_MAX if extremes else _ENTROPY)
    lines = [f"{_VERSION}-{kind}"]
    lines += [
        f"{name}: {struct.pack('!f', float(scale_of(*bounds))).hex()}"
        for name, bounds in ranges.tensors.items()
    ]
    write_bytes(path, ("\n".join(lines) + "\n").encode())


def write_onnxruntime_table(ranges: Ranges, folder: Path) -> None:
    """Write onnxruntime's calibration table into a folder, as its own tool does.

    That is ``calibration.flatbuffers``, which its TensorRT provider reads, and the same
    as ``calibration.json`` and ``calibration.cache`` (a line ``name reach`` per
    tensor).
    """
    # The table keeps the larger bound, not the magnitude: bounds are symmetric.
    table = dict[str, TensorData]()
    for name, (low, high) in ranges.tensors.items():
        reach = np.array(max(abs(low), abs(high)), np.float32)
        table[name] = TensorData(lowest=-reach, highest=reach)
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=folder, prefix=".table-") as draft:
        write_calibration_table(table, draft)
        for file in sorted(Path(draft).iterdir()):
            drafts.put(file, folder / file.name)


def read_cache(path: Path) -> Ranges:
    """Read a TensorRT cache, or the ``calibration.cache`` of an onnxruntime table.

    Neither names its graph: the digest is empty.

    Raises:
        FramesError: no such file, a malformed line, or no line.
    """
    if not path.is_file():
        raise FramesError(f"{path}: no such calibration cache")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise FramesError(f"{path}: not a calibration cache ({error})") from error
    # The head tells the two formats apart.
    head = _HEAD.fullmatch(lines[0]) if lines else None
    if lines and lines[0].startswith("TRT-"):

        def number(text: str) -> float:
            (scale,) = struct.unpack("!f", bytes.fromhex(text))
            return float(scale) * QUANT_MAX

        reach = _parse(path, lines, 1, ": ", number)
    else:
        reach = _parse(path, lines, 0, " ", float)
    if not reach:
        raise FramesError(f"{path}: a calibration cache without a tensor")
    bounds = {name: (-each, each) for name, each in reach.items()}
    return Ranges(bounds, IMPORTED, 0, "", "", calibrator=head[1] if head else "")


def taken_from(
    cache: Ranges, path: Path, model: ir.Model, tensors: Sequence[str]
) -> Ranges:
    """Take those of ``tensors`` that a cache has, by their names in ``model``.

    A node that stands for several of the file may have kept the name of the first, and
    gives what the last gave: its output is not taken.

    Raises:
        FramesError: the cache is of another graph: it has less than half of them.
    """
    merged = {
        str(value.name)
        for node in model.graph
        if (past := provenance.read(node)) is not None and len(past.origins) > 1
        for value in node.outputs
    }
    known = cache.tensors.keys() - merged
    bounds = {name: cache.tensors[name] for name in tensors if name in known}
    if len(bounds) < _LEAST * len(tensors):
        missing = [name for name in tensors if name not in bounds]
        raise FramesError(
            f"{path}: a cache of another graph: it lacks {missing[0]} and"
            f" {len(missing) - 1} more of {counted(len(tensors), 'tensor')}; it has"
            f" {next(iter(cache.tensors))}"
        )
    return dataclasses.replace(cache, tensors=bounds, model=digest(model))


def _parse(
    path: Path, lines: list[str], first: int, mark: str, read: Callable[[str], float]
) -> dict[str, float]:
    found = {}
    for number, line in enumerate(lines[first:], first + 1):
        name, parted, text = line.rpartition(mark)
        if name in found:
            raise FramesError(f"{path}: line {number} names {name} again")
        try:
            found[name] = read(text)
        except (ValueError, struct.error) as error:
            raise FramesError(
                f"{path}: line {number} is not a name and a number: {line[:60]!r}"
            ) from error
        if not parted or not 0 <= found[name] <= LARGEST:
            raise FramesError(f"{path}: line {number} is not a range: {line[:60]!r}")
    return found
