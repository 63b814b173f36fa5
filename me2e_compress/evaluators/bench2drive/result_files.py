"""Results of a leaderboard: its files and their records."""

import os
import re
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.metrics.episode import (
    FAILURES,
    LARGEST,
    Ending,
    Episode,
    Given,
    Infraction,
    InfractionKind,
)
from me2e_compress.simulator.routes import SCENARIO_ABILITIES

# The first percentage of a message, as efficiency_smoothness_benchmark.py finds it
_PERCENT = re.compile(r"\b\d+\.?\d*%")
_OUTSIDE = re.compile(r"\((\d+\.?\d*)% of")
_PLACE = re.compile(r"\(x=(-?\d+(?:\.\d+)?), y=(-?\d+(?:\.\d+)?)")
# What a scenario's name has after its type: `ParkingCutIn_1`
_NUMBER = re.compile(r"_\d+$")
_ROUTE = re.compile(r"[\w.-]{1,200}")
_OUTSIDE_LANES = InfractionKind.OUTSIDE_ROUTE_LANES

# By status. Bench2Drive repeats a route whose status is just `Failed`, as after a
# crash.
ENDINGS: Mapping[str, Ending] = {
    "Completed": Ending.COMPLETED,
    "Perfect": Ending.COMPLETED,
    "Failed - Agent deviated from the route": Ending.DEVIATION,
    "Failed - Agent got blocked": Ending.BLOCKED,
    "Failed - Agent timed out": Ending.TIMEOUT,
    "Failed - TickRuntime": Ending.TIMEOUT,
    "Failed - Agent crashed": Ending.POLICY_FAILED,
    "Failed - Agent couldn't be set up": Ending.POLICY_FAILED,
    "Failed - Agent's sensors were invalid": Ending.POLICY_FAILED,
    "Failed - Simulation crashed": Ending.SIMULATOR_FAILED,
    "Failed": Ending.SIMULATOR_FAILED,
}


class BrokenRecordError(ValueError):
    """A record is incomplete; the message is one line, without the file name."""


@dataclass(frozen=True)
class RouteRecord:
    """One parsed record."""

    episode: Episode  # the episode, without frames
    number: str  # the route's id in its routes file, such as `1711`
    recording: str | None  # name of the folder of its `metric_info.json`, if any
    duration_s: float | None  # simulated seconds; None if not stated
    content: str  # result of the route: equal for a copy of the record
    notes: tuple[str, ...] = ()  # values that could not be interpreted, one line each

    @property
    def crashed(self) -> bool:
        """Whether the simulator or the agent broke down."""
        return self.episode.ending in FAILURES


def read_record(raw: object) -> RouteRecord:
    """Parse one finished record; a `BrokenRecordError` if it is not whole."""
    try:
        record = _Record.model_validate(raw)
    except ValidationError as error:
        raise BrokenRecordError(_complaint(error, "record")) from error
    if not _ROUTE.fullmatch(record.route_id):
        raise BrokenRecordError(f"route_id: {record.route_id[:60]!r} is no name")
    # Read infractions, ending and scenario
    infractions = _infractions(record)
    ratios, notes = list[float](), list[str]()
    for infraction in infractions:
        speed = infraction.kind is InfractionKind.MIN_SPEED
        if infraction.percent is not None and speed:
            ratios.append(infraction.percent)
        if infraction.percent is None and (speed or infraction.kind is _OUTSIDE_LANES):
            words = f"no percentage in {infraction.detail[:60]!r}: left out"
            notes.append(f"{infraction.kind.value}: {words}")
    ending = ENDINGS.get(record.status)
    if ending is None:
        status = record.status[:60]
        raise BrokenRecordError(f"status {status!r} is not that of a finished route")
    scenario, scores = _NUMBER.sub("", record.scenario_name or ""), record.scores
    completion, composed = scores.score_route, scores.score_composed
    episode = Episode(
        route=record.route_id,
        scenario=scenario,
        abilities=SCENARIO_ABILITIES.get(scenario, ()),
        route_length_m=record.meta.route_length,
        completion_percent=completion,
        ending=ending,
        failure=record.status if ending in FAILURES else None,
        infractions=tuple(infractions),
        frames=(),
        decisions=(),
        speed_ratios_percent=tuple(ratios),
        given=Given(record.status, completion, scores.score_penalty, composed),
    )
    # Metadata that tell copies from other drives
    duration_s = record.meta.duration_game
    return RouteRecord(
        episode,
        number_of(record.route_id),
        record.save_name or None,
        duration_s if duration_s and duration_s > 0.0 else None,
        record.model_dump_json(exclude={"save_name", "meta"}),
        tuple(notes),
    )


def number_of(route_id: str) -> str:
    """Return ``1711`` for ``RouteScenario_1711_rep0``, as Bench2Drive's tools do."""
    parts = route_id.split("_")
    return parts[1] if len(parts) > 1 else route_id


_Finite = Annotated[float, Field(ge=-LARGEST, le=LARGEST)]


class _Part(BaseModel):
    model_config = ConfigDict(strict=True, extra="ignore", allow_inf_nan=False)


class _Scores(_Part):
    score_route: Annotated[float, Field(ge=0.0, le=100.0)]
    score_penalty: Annotated[float, Field(ge=0.0, le=1.0)]
    score_composed: Annotated[float, Field(ge=0.0, le=100.0)]


class _Meta(_Part):
    route_length: Annotated[float, Field(ge=0.0, le=LARGEST)] = 0.0
    duration_game: _Finite | None = None


class _Record(_Part):
    route_id: str
    scenario_name: str | None = None
    save_name: str | None = None
    status: str
    infractions: dict[str, list[str]]
    scores: _Scores
    meta: _Meta = Field(default_factory=_Meta)


def _complaint(error: ValidationError, whole: str) -> str:
    first = error.errors(include_url=False)[0]
    where = ".".join(str(part) for part in first["loc"]) or whole
    return f"{where}: {first['msg']}"


def _infractions(record: _Record) -> list[Infraction]:
    """Return an infraction a message, with the share or speed that it states."""
    infractions = list[Infraction]()
    for key, messages in record.infractions.items():
        if key not in set(InfractionKind):
            if messages:
                raise BrokenRecordError(f"infractions: nobody knows {key[:60]!r}")
            continue
        kind = InfractionKind(key)
        for message in messages:
            place = _PLACE.search(message)
            x, y = (float(part) for part in place.groups()) if place else (None, None)
            # The share outside the lanes, or the speed relative to the traffic's
            share = percent = None
            if kind is _OUTSIDE_LANES:
                share = _OUTSIDE.search(message) or _PERCENT.search(message)
            elif kind is InfractionKind.MIN_SPEED:
                share = _PERCENT.search(message)
            if share is not None:
                percent = float(share.group(share.re.groups).rstrip("%"))
                percent = min(percent, LARGEST)
            y = None if y is None else -y  # CARLA's y points right
            detail = " ".join(message.split())[:200]
            infractions.append(Infraction(kind, None, x, y, detail, percent))
    return infractions


_CHECKPOINT = b'"_checkpoint"'
# Names of a drive's recording, as Bench2Drive's agents have it, and of the log of its
# decisions: a line each, `frame` and `latency_us`
_RECORDING, _DECISIONS = "metric_info.json", "decisions.jsonl"


@dataclass
class ResultFile:
    """One results file; ``whole`` if all of its records could be read."""

    path: Path
    records: tuple[RouteRecord, ...] = ()
    whole: bool = True


@dataclass
class RunFiles:
    """Files of a run below a folder, ordered by path, and why some are broken."""

    results: list[ResultFile] = field(default_factory=list)
    recordings: list[Path] = field(default_factory=list)
    decisions: list[Path] = field(default_factory=list)
    broken: dict[str, str] = field(default_factory=dict)


def holds_records(folder: Path) -> bool:
    """Return whether there is any leaderboard results file below a folder."""
    return any(map(_is_checkpoint, _files(folder)))


def find_files(folder: Path) -> RunFiles:
    """Find and read the results files below a folder, and find its recordings."""
    if not folder.exists():
        raise EvaluationError(f"{folder}: no such folder")
    files = RunFiles()
    for path in _files(folder):
        if path.name == _DECISIONS:
            files.decisions.append(path)
        elif path.name == _RECORDING:
            files.recordings.append(path)
        elif _is_checkpoint(path):
            try:
                content = documents.from_json(documents.read_bytes(path), finite=False)
                document = _Document.model_validate(content)
            except documents.MalformedError as error:
                files.broken[str(path)] = f"not JSON: {error}"
                continue
            except ValidationError as error:
                files.broken[str(path)] = _complaint(error, "document")
                continue
            # A broken record does not spoil the others
            records, whole = list[RouteRecord](), True
            for place, raw in enumerate(document.checkpoint.records):
                try:
                    records.append(read_record(raw))
                except BrokenRecordError as error:
                    files.broken[f"{path}, record {place}"] = str(error)
                    whole = False
            files.results.append(ResultFile(path, tuple(records), whole))
    return files


def _files(folder: Path) -> Iterator[Path]:
    """Yield every JSON file once; links to folders are followed, not in circles."""
    if folder.is_file():
        yield folder
    visited = set[str]()
    for where, folders, names in os.walk(folder, followlinks=True):
        if (place := os.path.realpath(where)) in visited:
            folders.clear()
            continue
        visited.add(place)
        folders.sort()
        paths = (Path(where, name) for name in sorted(names))
        yield from (path for path in paths if ".json" in path.suffix and path.is_file())


def _is_checkpoint(path: Path) -> bool:
    """Return whether a file holds results: whole, cut short, in UTF-16 or too large."""
    if path.suffix != ".json":
        return False
    try:
        with path.open("rb") as file:
            content = file.read(documents.LARGEST_BYTES)
    except OSError:
        return False
    cut = b'{"_checkpoint"'.startswith(b"".join(content[:99].split()))
    return cut or _CHECKPOINT in content.replace(b"\0", b"")


class _Checkpoint(BaseModel):
    records: list[Any]


class _Document(BaseModel):
    model_config = ConfigDict(extra="ignore")
    checkpoint: _Checkpoint = Field(alias="_checkpoint")


def recordings_of(
    record: RouteRecord, paths: Sequence[Path], results: Sequence[ResultFile]
) -> tuple[Path, ...]:
    """Return the recordings (or logs) of a record, best match first; usually one.

    A drive's name ends in its start time, so repeated drives of a route differ. The
    folder of a recording, or one above it, has that name, sometimes with the name of
    the routes file as a prefix. A recording next to the only record of a folder belongs
    to that record.
    """
    exact, prefixed = list[Path](), list[Path]()
    for path in paths if record.recording else ():
        if record.recording in path.parent.parts:
            exact.append(path)
        elif any(part.endswith(f"_{record.recording}") for part in path.parent.parts):
            prefixed.append(path)
    if exact or prefixed:
        return (*exact, *prefixed)
    # Without such a folder: the only record of its folder
    holders = [file for file in results if record in file.records]
    folders = {file.path.parent for file in holders if len(file.records) == 1}
    alone = Counter(file.path.parent for file in results)
    beside = [path for path in paths if alone[path.parent] == 1]
    beside = [path for path in beside if path.parent in folders]
    return tuple(beside) if len(beside) == 1 else ()
