"""Evaluator that turns results of real CARLA runs into episodes."""

import json
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar, Self
from xml.etree import ElementTree

from me2e_compress.base import documents
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import Listener
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators.bench2drive.recordings import (
    TICK_S,
    BrokenRecordingError,
    read_decisions,
    read_recording,
)
from me2e_compress.evaluators.bench2drive.result_files import (
    RouteRecord,
    RunFiles,
    find_files,
    recordings_of,
)
from me2e_compress.evaluators.contract import Drive, Evaluator
from me2e_compress.metrics.episode import EgoFrame, Episode, InferenceRecord
from me2e_compress.metrics.scores import FULL_SET

_IDS = json.loads(Path(__file__).with_name("route_ids.json").read_bytes())
# The ids of the 220 routes of each version of Bench2Drive: those of
# leaderboard/data/bench2drive220.xml and of bench2drive_0.0.4_val.xml, which share two.
# The ten routes of "dev10" belong to the first.
ROUTE_SETS: dict[str, frozenset[str]] = {
    version: frozenset(ids) for version, ids in _IDS.items()
}


# What a recording or a log that is incomplete raises
UNREADABLE = (OSError, documents.MalformedError, BrokenRecordingError)


def _ids(routes: Path) -> frozenset[str]:
    """Read the ids of a leaderboard's routes file."""
    with documents.reading(routes, EvaluationError, "not a routes file"):
        try:
            root = ElementTree.fromstring(documents.read_bytes(routes))
        except ElementTree.ParseError as error:
            raise documents.MalformedError(str(error)) from error
    ids = frozenset(route.attrib.get("id", "") for route in root.iter("route")) - {""}
    if not ids:
        raise EvaluationError(f"{routes}: no <route id=...> stands in it")
    return ids


@dataclass
class CollectedResults:
    """Every route once, in the order of numbers, and everything else below a folder."""

    episodes: list[Episode] = field(default_factory=list)
    # The version of Bench2Drive, or the name of the user's own set, if the routes are
    # of a known one
    route_set: str | None = None
    set_size: int = FULL_SET
    crashed: list[str] = field(default_factory=list)
    # Numbers of the set's routes without a record
    missing: list[str] = field(default_factory=list)
    foreign: list[str] = field(default_factory=list)
    # Routes with identical records, as of a merged file and its parts
    repeated: list[str] = field(default_factory=list)
    # Routes that crashed and were driven again; the crash does not count
    rerun: list[str] = field(default_factory=list)
    # Routes with different results; the lowest driving score counts
    contradictory: list[str] = field(default_factory=list)
    # Incomplete files and records, with the reason
    broken: dict[str, str] = field(default_factory=dict)
    # Results files of workers killed on their first route
    unfinished: list[Path] = field(default_factory=list)
    # Routes without a recording of the ego
    unrecorded: list[str] = field(default_factory=list)
    # Seconds between two steps where that is not the simulator's rate
    off_rate: dict[str, float] = field(default_factory=dict)
    # How often the set was driven: a leaderboard's `--repetitions`
    repetitions: int = 1
    notes: list[str] = field(default_factory=list)

    @classmethod
    def of(cls, files: RunFiles, routes: Path | None = None) -> Self:
        """Choose one record of each route, and read the recordings that belong to it.

        One of the files must hold a record. `routes` is the set's file; None finds it.
        """
        # Sort the records of all results files by route
        made, by_route = cls(broken=files.broken), dict[str, list[RouteRecord]]()
        for file in files.results:
            for record in file.records:
                by_route.setdefault(record.episode.route, []).append(record)
            if not file.records and file.whole:
                made.unfinished.append(file.path)
        # Choose one record of each route, in order
        records = [made._chosen(route, copies) for route, copies in by_route.items()]
        for record in records:
            made.notes += (f"{record.episode.route}: {note}" for note in record.notes)
        records.sort(key=lambda record: (_by_number(record.number), record.content))
        made.crashed = [record.episode.route for record in records if record.crashed]
        # Build episodes with frames and decisions
        others = list(files.recordings)
        for record in records:
            paths = recordings_of(record, files.recordings, files.results)
            logs = recordings_of(record, files.decisions, files.results)
            others = [path for path in others if path not in paths]
            frames = made._frames(record, paths)
            decisions: tuple[InferenceRecord, ...] = ()
            for path in logs:  # the first whole one
                try:
                    decisions = read_decisions(path)
                    break
                except UNREADABLE as error:
                    made.broken[str(path)] = str(error)
            episode = replace(record.episode, frames=frames, decisions=decisions)
            made.episodes.append(episode)
        if others:
            more = f" and {len(others) - 1} others" if len(others) > 1 else ""
            made.notes.insert(0, f"{others[0]}{more}: of no record")
        # Find which routes of the set are missing, and which are foreign
        times = Counter(record.number for record in records)
        made.repetitions = max(times.values())
        sets = dict(ROUTE_SETS) if routes is None else {routes.stem: _ids(routes)}
        best = max(sets, key=lambda name: len(sets[name] & set(times)))
        whole = sets[best]
        made.set_size = len(whole)
        if whole & set(times):
            made.route_set = best
            made.missing = sorted(whole - set(times), key=_by_number)
            foreign = (record for record in records if record.number not in whole)
            made.foreign = [record.episode.route for record in foreign]
        return made

    def _chosen(self, route: str, records: Sequence[RouteRecord]) -> RouteRecord:
        """Choose one record of a route, so that uncertainty never improves a result.

        A drive replaces a crash, as when Bench2Drive resumes; of different results the
        lowest score counts.
        """
        # Identical copies count once
        distinct = list({record.content: record for record in records}.values())
        if len(distinct) < len(records):
            self.repeated.append(route)
        # Crashes count only without a drive
        drives = [record for record in distinct if not record.crashed]
        if drives and len(drives) < len(distinct):
            self.rerun.append(route)
        counted = drives or distinct
        if len(counted) > 1:
            self.contradictory.append(route)

        def lowest_first(record: RouteRecord) -> tuple[float, bool, str]:
            given = record.episode.given
            composed = given.composed_percent if given else 0.0
            return composed, record.episode.succeeded, record.content

        return min(counted, key=lowest_first)

    def _frames(
        self, record: RouteRecord, paths: Sequence[Path]
    ) -> tuple[EgoFrame, ...]:
        """Return the frames of the first whole recording; others are reported."""
        route = record.episode.route
        if not paths:
            self.unrecorded.append(route)
        for path in paths:
            try:
                raw = documents.from_json(documents.read_bytes(path), finite=False)
                recording = read_recording(raw)
            except UNREADABLE as error:
                self.broken[str(path)] = str(error)
                continue
            if len(paths) > 1:
                self.notes.append(f"{path}: one of {len(paths)} of the same drive")
            if not recording.in_order:
                self.notes.append(f"{path}: steps out of order: comfort is of no drive")
            interval_s = recording.interval_s(record.duration_s)
            if interval_s != TICK_S:
                self.off_rate[route] = interval_s
            return recording.frames(interval_s)
        return ()


@dataclass(frozen=True)
class Bench2DriveResults(Evaluator):
    """Read the results of real Bench2Drive or CARLA leaderboard runs.

    Attributes:
        folder: Results files, recordings and logs are found below it; or one results
            file.
        metrics: Recordings (``metric_info.json``) are found below it too; None has
            none apart.
        route_file: A leaderboard's routes file, whose routes are the whole set; None
            finds which of Bench2Drive's it is.
    """

    name: ClassVar[str] = "bench2drive"
    folder: Path
    metrics: Path | None = None
    route_file: Path | None = None

    @property
    def set_size(self) -> int:
        """How many routes a whole benchmark has."""
        return FULL_SET if self.route_file is None else len(_ids(self.route_file))

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        """Yield each route once, in the order of the routes' numbers.

        Raises:
            EvaluationError: There is no such folder, or no record below it.
        """
        yield from self.collect().episodes

    def collect(self) -> CollectedResults:
        """Read all files: the episodes, and what was wrong with the files."""
        files = find_files(self.folder)
        if self.metrics is not None:
            apart = find_files(self.metrics)
            files.recordings += apart.recordings
            files.decisions += apart.decisions
        # One folder may lie in the other
        for paths in (files.recordings, files.decisions):
            paths[:] = {path.resolve(): path for path in paths}.values()
        if not any(file.records for file in files.results):
            whys = (f": {place}: {why}" for place, why in files.broken.items())
            none = f"{self.folder}: no whole record of a leaderboard below it"
            raise EvaluationError(f"{none}{next(whys, '')}")
        return CollectedResults.of(files, self.route_file)


def _by_number(number: str) -> tuple[int, str]:
    """Return a sort key that orders routes by number."""
    return (int(number), "") if number.isascii() and number.isdecimal() else (0, number)
