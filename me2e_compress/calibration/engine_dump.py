"""Read what an engine answered elsewhere over recorded frames.

A dump is a folder with a file a frame, named as the frame is: ``.npz`` keyed by tensor
name, or the JSON of ``trtexec --exportOutput``; or one JSON file of polygraphy's
``RunResults``, an iteration a frame, in order.
"""

import base64
import binascii
import functools
import io
import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from me2e_compress.calibration.dataset import (
    CalibrationSet,
    Declared,
    declared,
    load_arrays,
)
from me2e_compress.display import counted, reason
from me2e_compress.errors import FramesError
from me2e_compress.registry import documents
from me2e_compress.runtime.frames import Array

_NPZ, _JSON = ".npz", ".json"
_NOT_JSON = re.compile(rb"(?<=[\[,\s])(-?)(nan|inf)(?=[\],\s])", re.IGNORECASE)
"""What C++ writes, and trtexec with it, where a number is not finite."""
_UNFIT = (AttributeError, TypeError, LookupError, ValueError)
"""What reading a document raises that is JSON and of another form."""
_KEPT = 8
"""Frames in memory: some are read again and again."""


class EngineDump:
    """What an engine answered, read frame by frame.

    Attributes:
        path: The folder or file.
        stems: Names of the frames that were answered; numbers where the dump has none.
        names: Of the tensors of each frame, in the order of the first.

    Raises:
        FramesError: no such dump, no answers, or a file that cannot be read.
    """

    def __init__(self, path: str | Path) -> None:
        self.path = Path(path)
        self._read, self.stems, self.named = _opened(self.path)
        self._at = functools.lru_cache(maxsize=_KEPT)(self._read)
        self.names = tuple(self[0])

    def __len__(self) -> int:
        return len(self.stems)

    def __getitem__(self, index: int) -> Mapping[str, Array]:
        """Read what was answered to one frame."""
        return self._at(index)

    def __iter__(self) -> Iterator[Mapping[str, Array]]:
        """Read the answers in order, one frame in memory at a time."""
        return (self[index] for index in range(len(self)))

    def where(self, index: int) -> str:
        """Name a frame's answers in a message."""
        if self.path.is_dir() and self.named:
            return str(self.path / self.stems[index])
        return f"{self.path}: frame {index}"

    def check(self, frames: CalibrationSet) -> None:
        """Check that every frame was answered, and with the same tensors.

        Raises:
            FramesError: frames are missing or unknown, a tensor is missing in one or
                not of numbers, or a file is cut.
        """
        stems = {each.stem: None for each in frames.files}
        if len(self) != len(frames):
            lacking = [each for each in stems if self.named and each not in self.stems]
            first = f"{lacking[0]} is not answered: " if lacking else ""
            raise FramesError(
                f"{self.path}: {first}answers to {counted(len(self), 'frame')},"
                f" {frames.folder} has {len(frames)}: the dump is of other frames"
            )
        unknown = [each for each in self.stems if each not in stems]
        if self.named and unknown:
            raise FramesError(
                f"{self.path}: {unknown[0]} is answered and is no frame of"
                f" {frames.folder}, whose first is {frames.files[0].stem}"
            )
        is_npz = self.path.is_dir() and (self.path / f"{self.stems[0]}{_NPZ}").is_file()
        for index, stem in enumerate(self.stems):
            tensors: Mapping[str, Array | Declared]
            tensors = (
                declared(self.path / f"{stem}{_NPZ}") if is_npz else self._read(index)
            )
            if lacking := [each for each in self.names if each not in tensors]:
                where = self.where(index)
                raise FramesError(
                    f"{where}: {lacking[0]} is missing; other frames have it"
                )
            if more := [each for each in tensors if each not in self.names]:
                raise FramesError(
                    f"{self.where(0)}: {more[0]} is missing; other frames have it"
                )
            for name, each in tensors.items():
                if each.dtype.kind not in "fiub":
                    raise FramesError(
                        f"{self.where(index)}: {name} is {each.dtype}, which is no"
                        " number; write bfloat16 as float32"
                    )


def _opened(
    path: Path,
) -> tuple[Callable[[int], Mapping[str, Array]], tuple[str, ...], bool]:
    """Return what reads a frame, the names of frames, and whether files have them."""
    if not path.exists():
        raise FramesError(f"{path}: no such folder or file")
    if path.is_dir():
        answers = (each for each in path.iterdir() if each.suffix in (_NPZ, _JSON))
        files = sorted(each for each in answers if each.name != "scenes.json")
        kinds = {each.suffix for each in files}
        if len(kinds) != 1:
            held = "both .npz and .json" if kinds else "no .npz and no .json"
            raise FramesError(f"{path}: holds {held} of an engine's answers")
    else:
        files, kinds = [path], {path.suffix}
    if kinds == {_NPZ}:
        names = tuple(each.stem for each in files)
        return (lambda index: load_arrays(files[index])), names, True
    # one file of polygraphy holds all frames; trtexec writes a file for each
    first = _document(files[0])
    if isinstance(first, dict) and len(files) == 1:
        results = _run_results(files[0], first)
        return results.__getitem__, tuple(map(str, range(len(results)))), False
    names = tuple(each.stem for each in files)
    return (lambda index: _exported(files[index])), names, True


def _document(path: Path) -> Any:
    with documents.reading(path, FramesError, "not the JSON of an engine's answers"):
        text = documents.content(path, documents.LARGEST_LOG_BYTES)
        if b"nan" in text or b"inf" in text:
            text = _NOT_JSON.sub(  # as Python spells them
                lambda m: b"NaN" if m[2].lower() == b"nan" else m[1] + b"Infinity", text
            )
        return documents.from_json(text, finite=False)


def _exported(path: Path) -> Mapping[str, Array]:
    """Read the file of ``trtexec --exportOutput``: names, 1x6x2, and values."""
    found = _document(path)
    try:
        return {str(each["name"]): _values(each) for each in found}
    except _UNFIT as error:
        raise FramesError(
            f"{path}: not what trtexec --exportOutput writes, a list of name,"
            f" dimensions and values ({reason(error)})"
        ) from error


def _values(each: Mapping[str, Any]) -> Array:
    sides = [int(side) for side in each["dimensions"].split("x") if side]
    values = np.array(each["values"])
    if values.size != np.prod(sides, dtype=int):
        raise ValueError(
            f"{each['name']} has {values.size} values for {each['dimensions']}"
        )
    if values.dtype.kind not in "fiub":
        raise ValueError(f"{each['name']} has values that are no numbers")
    # six digits are written, whatever the type was
    kind = np.float32 if values.dtype.kind == "f" else values.dtype
    return values.astype(kind).reshape(sides)


def _run_results(path: Path, document: Mapping[str, Any]) -> list[Mapping[str, Array]]:
    """Read polygraphy's RunResults: the iterations of its one runner."""

    def array(name: str, lazy: Mapping[str, Any]) -> Array:
        values = lazy["values"]
        kind = values.get("polygraphy_class")
        if kind != "ndarray":
            raise ValueError(f"{name} is a {kind}, not an ndarray")
        try:
            content = base64.b64decode(values["array"], validate=True)
        except binascii.Error as error:
            raise ValueError(f"{name}: {error}") from error
        return np.asarray(np.load(io.BytesIO(content), allow_pickle=False))

    try:
        runners: Sequence[Any] = document["lst"]
        if len(runners) != 1:
            raise ValueError(f"{len(runners)} runners, expected one: save each alone")
        found: list[Mapping[str, Array]] = [
            {name: array(name, each) for name, each in iteration["outputs"].items()}
            for iteration in runners[0][1]
        ]
    except (*_UNFIT, EOFError) as error:
        line = f"no {error}" if isinstance(error, KeyError) else reason(error)
        raise FramesError(
            f"{path}: not the RunResults that polygraphy --save-outputs writes ({line})"
        ) from error
    if not found:
        raise FramesError(f"{path}: holds no iteration")
    return found
