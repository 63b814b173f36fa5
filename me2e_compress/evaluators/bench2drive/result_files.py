"""Find result files and recordings below a folder by content, not by name."""

import codecs
import math
import os
import re
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.records import (
    BrokenRecordError,
    RouteRecord,
    read_record,
)
from me2e_compress.metrics.episode import LARGEST
from me2e_compress.registry import documents

_CHECKPOINT = b'"_checkpoint"'
_STEP = re.compile(rb'\s*\{\s*"-?\d+"\s*:\s*\{\s*"\w+"\s*:\s*\[')
_PARTS = (b'"angular_velocity"', b'"forward_vector"')
_BEGUN, _UTF_16 = b"begun", b"UTF-16"
_UNREADABLE = {
    _BEGUN: "it ends before it says what it is",
    _UTF_16: "not UTF-8 but UTF-16, as PowerShell writes it",
}
_RECORDING = "metric_info.json"
"""Name that Bench2Drive's agents use; needed if the content is ambiguous."""
_DECISIONS = "decisions.jsonl"
"""Name of the log of decisions: a line each, `frame` and `latency_us`."""
_HEAD_BYTES = 4096
_PICTURES = {".png", ".jpg", ".jpeg", ".gif", ".mp4", ".npz", ".npy", ".laz", ".bin"}


@dataclass
class ResultFile:
    """One results file: a worker's checkpoint, or several merged.

    ``broken`` says why records could not be read, by their index. ``stated`` are the
    scores that a merged file states, NaN if not a number.
    """

    path: Path
    records: tuple[RouteRecord, ...] = ()
    broken: dict[int, str] = field(default_factory=dict)
    stated: dict[str, float] = field(default_factory=dict)


@dataclass
class FoundFiles:
    """Files found below a folder, ordered by path; ``broken`` ones with the reason."""

    results: list[ResultFile] = field(default_factory=list)
    recordings: list[Path] = field(default_factory=list)
    decisions: list[Path] = field(default_factory=list)
    broken: dict[Path, str] = field(default_factory=dict)


def holds_records(folder: Path) -> bool:
    """Return whether there is any leaderboard results file below a folder."""
    return any(kind == _CHECKPOINT for _, kind in _kinds(folder))


def find_files(folder: Path) -> FoundFiles:
    """Find and read the results files below a folder, and find its recordings."""
    if not folder.exists():
        raise EvaluationError(f"{folder}: no such folder")
    found = FoundFiles()
    for path, kind in _kinds(folder):
        if path.name == _DECISIONS:
            found.decisions.append(path)
        # incomplete files are reported, recordings are only listed
        if kind is None:
            continue
        if kind in _UNREADABLE:
            found.broken[path] = _UNREADABLE[kind]
            continue
        if kind != _CHECKPOINT:
            found.recordings.append(path)
            continue
        try:
            found.results.append(_read(path))
        except documents.MalformedError as error:
            found.broken[path] = f"not JSON: {error}"
        except (OSError, BrokenRecordError) as error:
            found.broken[path] = str(getattr(error, "strerror", None) or error)
    return found


def _kinds(folder: Path) -> Iterator[tuple[Path, bytes | None]]:
    """Yield every file with the bytes that identify its kind, None for others."""
    if folder.is_file():
        yield folder, _kind(folder)
    seen = set[str]()
    for where, folders, names in os.walk(folder, followlinks=True):
        if (place := os.path.realpath(where)) in seen:  # links may go round in circles
            folders.clear()
            continue
        seen.add(place)
        folders.sort()
        for name in sorted(names):
            path = Path(where, name)
            if path.suffix.lower() not in _PICTURES and os.path.isfile(path):
                yield path, _kind(path)


def _kind(path: Path) -> bytes | None:
    """Look at the beginning of a file, and at the rest if that is inconclusive."""
    try:
        with path.open("rb") as file:
            head = file.read(_HEAD_BYTES).removeprefix(codecs.BOM_UTF8)
            # files that their name or first bytes identify
            if path.name == _RECORDING:
                return _PARTS[0]
            if path.suffix == ".json":
                if head.startswith((codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE)):
                    return _UTF_16
                if _is_begun(head):
                    return _BEGUN
            if not head.lstrip().startswith(b"{"):
                return None
            # the key of a checkpoint or of recorded steps in the first 4 KiB
            if _CHECKPOINT in head:
                return _CHECKPOINT
            if _STEP.match(head):
                return _PARTS[0] if all(part in head for part in _PARTS) else None
            if path.stat().st_size > documents.LARGEST_BYTES:
                return None
            rest = head[-len(_CHECKPOINT) :] + file.read()
            return _CHECKPOINT if _CHECKPOINT in rest else None
    except OSError:
        return None


def _is_begun(head: bytes) -> bool:
    """Return whether a file ends before its first key, as after a kill."""
    return b'{"_checkpoint"'.startswith(b"".join(head.split()))


def _read(path: Path) -> ResultFile:
    document = documents.from_json(documents.content(path), finite=False)
    try:
        checked = _Document.model_validate(document)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        where = ".".join(str(part) for part in first["loc"]) or "document"
        raise BrokenRecordError(f"{where}: {first['msg']}") from error
    records, broken = list[RouteRecord](), dict[int, str]()
    for place, raw in enumerate(checked.checkpoint.records):
        try:
            records.append(read_record(raw))
        except BrokenRecordError as error:
            broken[place] = str(error)
    return ResultFile(path, tuple(records), broken, checked.stated())


def _number(value: object) -> float | None:
    """Return NaN for anything but a number: the records are read all the same."""
    if value is None:
        return None
    if isinstance(value, (int, float)) and abs(value) <= LARGEST:
        return float(value)
    return math.nan


_Stated = Annotated[float | None, BeforeValidator(_number)]


class _Checkpoint(BaseModel):
    records: list[Any]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore")
    checkpoint: _Checkpoint = Field(alias="_checkpoint")
    driving_score: _Stated = Field(None, alias="driving score")
    success_rate: _Stated = Field(None, alias="success rate")
    eval_num: _Stated = Field(None, alias="eval num")

    def stated(self) -> dict[str, float]:
        written = {
            "driving score": self.driving_score,
            "success rate": self.success_rate,
            "eval num": self.eval_num,
        }
        return {name: value for name, value in written.items() if value is not None}


class DriveRecordings:
    """Finds the recording (or log) of a record, and those that match no record.

    A drive's name ends in its start time, so repeated drives of a route differ. The
    recording's folder or file has that name, sometimes with the name of the routes file
    as a prefix. A recording next to the only record of a folder belongs to that record.
    """

    def __init__(self, paths: Sequence[Path], results: Sequence[ResultFile]) -> None:
        self._names = {path: (*path.parent.parts, path.stem) for path in paths}
        self._taken = set[Path]()
        alone = Counter(file.path.parent for file in results)
        self._beside = {
            record.content: file.path.parent
            for file in results
            if alone[file.path.parent] == 1 and len(file.records) == 1
            for record in file.records
        }

    def of(self, record: RouteRecord) -> tuple[Path, ...]:
        """Return the recordings of a record, best match first; usually one."""
        found = self._named(record.recording) if record.recording else ()
        if not found:
            where = self._beside.get(record.content)
            found = tuple(path for path in self._names if path.parent == where)
            found = found if len(found) == 1 else ()
        self._taken.update(found)
        return found

    @property
    def of_none(self) -> list[Path]:
        """Recordings that matched no record asked for so far."""
        return [path for path in self._names if path not in self._taken]

    def _named(self, name: str) -> tuple[Path, ...]:
        exact, prefixed = list[Path](), list[Path]()
        for path, names in self._names.items():
            if name in names:
                exact.append(path)
            elif any(each.endswith(f"_{name}") for each in names):
                prefixed.append(path)
        return (*exact, *prefixed)
