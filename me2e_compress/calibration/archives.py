"""Write ``.npz`` files, and read them, checking their sizes first."""

import dataclasses
import io
import math
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import IO

import numpy as np

from me2e_compress.display import reason
from me2e_compress.errors import FramesError
from me2e_compress.registry import marks
from me2e_compress.registry.documents import UNREADABLE, check_regular
from me2e_compress.runtime.frames import Array

LARGEST_BYTES = 2 << 30
"""The most bytes of all arrays of one file. Six full-size camera images have 0.1 GB."""


@dataclasses.dataclass(frozen=True)
class Declared:
    """Shape and type of an array, as its file states."""

    shape: tuple[int, ...]
    dtype: np.dtype[np.generic]


def declared(path: Path, what: str = "a readable .npz") -> Mapping[str, Declared]:
    """Read the headers of an ``.npz`` by array name, without the arrays.

    The message calls the expected content ``what``.
    """
    try:
        check_regular(path)
        with path.open("rb") as source, zipfile.ZipFile(source) as archive:
            found = [_member(archive, each) for each in archive.infolist()]
    except UNREADABLE as error:
        raise FramesError(f"{path}: not {what} ({reason(error)})") from error
    # A name may occur once only.
    if len(dict(found)) < len(found):
        raise FramesError(f"{path}: not {what} (an array is there twice)")
    # A header could claim any size: check before reading.
    total = sum(_bytes(each) for _, each in found)
    if total > LARGEST_BYTES:
        raise FramesError(
            f"{path}: not {what}: its arrays have {total:,} bytes, more than"
            f" {LARGEST_BYTES:,}"
        )
    return dict(found)


def load_arrays(path: Path, what: str = "a readable .npz") -> dict[str, Array]:
    """Read every array of an ``.npz`` by name, after the checks of :func:`declared`."""
    declared(path, what)
    try:
        with path.open("rb") as source, np.load(source, allow_pickle=False) as content:
            return {name: np.asarray(content[name]) for name in content}
    except UNREADABLE as error:
        raise FramesError(f"{path}: not {what} ({reason(error)})") from error


def archive_of(arrays: Mapping[str, Array]) -> bytes:
    """Return an ``.npz`` of arrays; equal arrays give equal bytes."""
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        archive.comment = marks.BYTES
        for name, array in arrays.items():
            with archive.open(f"{name}.npy", "w", force_zip64=True) as entry:
                np.lib.format.write_array(entry, np.asanyarray(array))
    return content.getvalue()


def _member(archive: zipfile.ZipFile, entry: zipfile.ZipInfo) -> tuple[str, Declared]:
    with archive.open(entry) as stream:
        about = _header(stream)
        begin = stream.tell()
    if entry.file_size != begin + _bytes(about):
        raise ValueError(
            f"{entry.filename} has {entry.file_size} bytes, its header says"
            f" {begin + _bytes(about)}"
        )
    return entry.filename.removesuffix(".npy"), about


def _header(stream: IO[bytes]) -> Declared:
    version = np.lib.format.read_magic(stream)
    if version == (1, 0):
        shape, _, dtype = np.lib.format.read_array_header_1_0(stream)
    elif version == (2, 0):
        shape, _, dtype = np.lib.format.read_array_header_2_0(stream)
    else:
        raise ValueError(f"an array of version {version}")
    # Objects would be unpickled, which runs code.
    if dtype.hasobject:
        raise ValueError("an array of Python objects")
    if any(side < 0 for side in shape):
        raise ValueError(f"an array of shape {shape}")
    return Declared(tuple(shape), dtype)


def _bytes(about: Declared) -> int:
    return math.prod(about.shape) * about.dtype.itemsize
