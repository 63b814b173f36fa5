"""Read ranges of other tools: TensorRT's cache, onnxruntime's table.

Both store one number per tensor, so these ranges are symmetric: [-reach, reach].
"""

import dataclasses
import struct
from collections.abc import Callable, Sequence
from pathlib import Path

import onnx_ir as ir

from me2e_compress.base.display import join_names, plural
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.calibration.ranges import IMPORTED, LARGEST, Ranges
from me2e_compress.graph import digest, provenance

# Least share of the needed tensors that a cache of this graph has
_LEAST_SHARE = 0.5


def read_cache(path: Path) -> Ranges:
    """Read a TensorRT cache, or the ``calibration.cache`` of an onnxruntime table.

    Neither names its graph: the digest is empty. A malformed line is a FramesError.
    """
    if not path.is_file():
        raise FramesError(f"{path}: no such calibration cache")
    try:
        lines = path.read_text(encoding="utf-8").splitlines()
    except UnicodeDecodeError as error:
        raise FramesError(f"{path}: not a calibration cache ({error})") from error
    # The head tells the two formats apart.
    if lines and lines[0].startswith("TRT-"):

        def number(text: str) -> float:
            (scale,) = struct.unpack("!f", bytes.fromhex(text))
            return float(scale) * QUANT_MAX

        reach = _parse_lines(path, lines, 1, ": ", number)
    else:
        reach = _parse_lines(path, lines, 0, " ", float)
    if not reach:
        raise FramesError(f"{path}: a calibration cache without a tensor")
    bounds = {name: (-bound, bound) for name, bound in reach.items()}
    return Ranges(bounds, IMPORTED, 0, "", "")


def pick_ranges(
    cache: Ranges, path: Path, model: ir.Model, tensors: Sequence[str]
) -> Ranges:
    """Return the ranges of ``tensors`` that a cache has, by names in ``model``."""
    # A node that replaces several of the file may have the name of the first, and the
    # output of the last: its range is not used
    merged = {
        str(value.name)
        for node in model.graph
        if (past := provenance.read(node)) is not None and len(past.origins) > 1
        for value in node.outputs
    }
    known = cache.tensors.keys() - merged
    bounds = {name: cache.tensors[name] for name in tensors if name in known}
    # A cache that has less than half of them is of another graph
    if len(bounds) < _LEAST_SHARE * len(tensors):
        missing = [name for name in tensors if name not in bounds]
        raise FramesError(
            f"{path}: a cache of another graph: of {plural(len(tensors), 'tensor')}"
            f" it lacks {join_names(missing, 1)}; it has {next(iter(cache.tensors))}"
        )
    return dataclasses.replace(cache, tensors=bounds, model=digest(model))


def _parse_lines(
    path: Path, lines: list[str], first: int, mark: str, read: Callable[[str], float]
) -> dict[str, float]:
    """Read a number a line by name; a FramesError names a line that has none."""
    values = {}
    for number, line in enumerate(lines[first:], first + 1):
        name, separator, text = line.rpartition(mark)
        if name in values:
            raise FramesError(f"{path}: line {number} names {name} again")
        try:
            values[name] = read(text)
        except (ValueError, struct.error) as error:
            raise FramesError(
                f"{path}: line {number} is not a name and a number: {line[:60]!r}"
            ) from error
        if not separator or not 0 <= values[name] <= LARGEST:
            raise FramesError(f"{path}: line {number} is not a range: {line[:60]!r}")
    return values
