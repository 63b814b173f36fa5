"""Results of real runs as an evaluator: what drove in CARLA, as episodes."""

import dataclasses
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress import documents
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.drive_recordings import DriveRecordings
from me2e_compress.evaluators.bench2drive.logged_decisions import read_decisions
from me2e_compress.evaluators.bench2drive.recordings import (
    TICK_S,
    BrokenRecordingError,
    RecordedRoute,
    read_recording,
)
from me2e_compress.evaluators.bench2drive.records import RouteRecord
from me2e_compress.evaluators.bench2drive.result_files import (
    FoundFiles,
    ResultFile,
    find_files,
)
from me2e_compress.evaluators.bench2drive.route_sets import (
    ROUTE_SETS,
    RouteSet,
    by_number,
    likely_set,
)
from me2e_compress.metrics.episode import Episode, InferenceRecord
from me2e_compress.metrics.scores import FULL_SET


@dataclass(frozen=True)
class CollectedResults:
    """Every route once, and what was found beside.

    Attributes:
        episodes: In the order of their routes' numbers.
        route_set: The version of Bench2Drive that brought the routes; None if they
            are of neither.
        crashed: Routes on which the simulator or the agent broke down.
        missing: Numbers of the set's routes without a record.
        foreign: Routes of another set.
        repeated: Routes with the same record more than once, as a merged file has
            beside its parts.
        rerun: Routes that crashed first and were driven again: the crash does not
            count.
        contradictory: Routes driven more than once with different results: the lowest
            driving score counts.
        broken: Files and records that are not whole, with the reason.
        unfinished: Results files without a record, as a worker that was killed on its
            first route leaves them.
        unrecorded: Routes without a recording of the ego.
        off_rate: Routes recorded at another rate than the simulator's, with the
            seconds between two steps.
        repetitions: How often the set was driven: a leaderboard's ``--repetitions``.
        stated: Merged files, which say something of themselves.
        notes: Surprises, one line each.
    """

    episodes: tuple[Episode, ...]
    route_set: RouteSet | None
    crashed: tuple[str, ...] = ()
    missing: tuple[str, ...] = ()
    foreign: tuple[str, ...] = ()
    repeated: tuple[str, ...] = ()
    rerun: tuple[str, ...] = ()
    contradictory: tuple[str, ...] = ()
    broken: Mapping[str, str] = dataclasses.field(default_factory=dict)
    unfinished: tuple[Path, ...] = ()
    unrecorded: tuple[str, ...] = ()
    off_rate: Mapping[str, float] = dataclasses.field(default_factory=dict)
    repetitions: int = 1
    stated: Mapping[Path, ResultFile] = dataclasses.field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class Bench2DriveResults:
    """Read the results of real Bench2Drive or CARLA leaderboard runs.

    Attributes:
        folder: Results files and recordings are found below it by what they hold; or
            one results file.
        metrics: Recordings (``metric_info.json``) are found below it too; None has
            none apart.
    """

    name: ClassVar[str] = "bench2drive"
    folder: Path
    metrics: Path | None = None

    @property
    def set_size(self) -> int:
        """How many routes a whole benchmark has."""
        return FULL_SET

    def episodes(self) -> Iterator[Episode]:
        """Yield each route once, in the order of the routes' numbers.

        Raises:
            EvaluationError: There is no such folder, or no record below it.
        """
        yield from self.collect().episodes

    def collect(self) -> CollectedResults:
        """Read everything, and say what was found beside the episodes.

        Raises:
            EvaluationError: There is no such folder, or no record below it.
        """
        found = find_files(self.folder)
        if self.metrics is not None:
            apart = find_files(self.metrics)
            found.recordings += apart.recordings
            found.decisions += apart.decisions
        found.recordings = _once(found.recordings)
        found.decisions = _once(found.decisions)
        if not any(file.records for file in found.results):
            raise EvaluationError(f"{self.folder}: {_nothing(found)}")
        return _Collection(found).results()


def _once(paths: Sequence[Path]) -> list[Path]:
    return list({path.resolve(): path for path in paths}.values())


def _nothing(found: FoundFiles) -> str:
    for path, reason in found.broken.items():
        return f"no results of a leaderboard: {path.name}: {reason}"
    for file in found.results:
        for place, reason in file.broken.items():
            return f"no whole record: {file.path.name}: record {place}: {reason}"
        return f"no record: {file.path.name} holds none"
    return "no results of a leaderboard below it"


class _Collection:
    """Sorts what was found."""

    def __init__(self, found: FoundFiles) -> None:
        self.found = found
        self.repeated, self.rerun = list[str](), list[str]()
        self.contradictory = list[str]()
        self.unrecorded, self.off_rate = list[str](), dict[str, float]()
        self.notes = list[str]()
        self.broken = {str(path): why for path, why in found.broken.items()}
        for file in found.results:
            for place, reason in file.broken.items():
                self.broken[f"{file.path}, record {place}"] = reason

    def results(self) -> CollectedResults:
        records = self._one_each()
        recorded = DriveRecordings(self.found.recordings, self.found.results)
        logs = DriveRecordings(self.found.decisions, self.found.results)
        episodes = tuple(
            dataclasses.replace(
                self._with_frames(each, recorded),
                decisions=self._decisions(logs.of(each)),
            )
            for each in records
        )
        if others := recorded.of_none:
            more = f" and {len(others) - 1} others" if len(others) > 1 else ""
            self.notes.insert(0, f"{others[0]}{more}: of no record")
        numbers = [each.number for each in records]
        route_set = likely_set(numbers)
        whole = ROUTE_SETS[route_set] if route_set else frozenset[str]()
        return CollectedResults(
            episodes,
            route_set,
            crashed=tuple(each.episode.route for each in records if each.crashed),
            missing=tuple(sorted(whole - set(numbers), key=by_number)),
            foreign=tuple(
                each.episode.route
                for each in records
                if route_set and each.number not in whole
            ),
            repeated=tuple(self.repeated),
            rerun=tuple(self.rerun),
            contradictory=tuple(self.contradictory),
            broken=self.broken,
            unfinished=tuple(
                file.path
                for file in self.found.results
                if not file.records and not file.broken
            ),
            unrecorded=tuple(self.unrecorded),
            off_rate=self.off_rate,
            repetitions=max(Counter(numbers).values()),
            stated={file.path: file for file in self.found.results if file.stated},
            notes=tuple(self.notes),
        )

    def _one_each(self) -> list[RouteRecord]:
        by_route = dict[str, list[RouteRecord]]()
        for file in self.found.results:
            for record in file.records:
                by_route.setdefault(record.episode.route, []).append(record)
        chosen = [self._chosen(route, each) for route, each in by_route.items()]
        for record in chosen:
            self.notes += (f"{record.episode.route}: {note}" for note in record.notes)
        return sorted(chosen, key=lambda each: (by_number(each.number), each.content))

    def _chosen(self, route: str, records: Sequence[RouteRecord]) -> RouteRecord:
        """Choose one record of a route; what cannot be known must not flatter.

        A crash gives way to a drive, as when Bench2Drive resumes. Of drives that ended
        differently the lowest score counts: the best of two would be no evaluation.
        """
        distinct = list({each.content: each for each in records}.values())
        if len(distinct) < len(records):
            self.repeated.append(route)
        drives = [each for each in distinct if not each.crashed]
        if drives and len(drives) < len(distinct):
            self.rerun.append(route)
        counted = drives or distinct
        if len(counted) > 1:
            self.contradictory.append(route)
        return min(counted, key=_lowest_first)

    def _with_frames(self, record: RouteRecord, recorded: DriveRecordings) -> Episode:
        episode, paths = record.episode, recorded.of(record)
        if not paths:
            self.unrecorded.append(episode.route)
        for path in paths:
            recording = self._read(path)
            if recording is None:
                continue
            if len(paths) > 1:
                self.notes.append(f"{path}: one of {len(paths)} of the same drive")
            if not recording.in_order:
                self.notes.append(f"{path}: steps out of order: comfort is of no drive")
            interval_s = recording.interval_s(record.duration_s)
            if interval_s != TICK_S:
                self.off_rate[episode.route] = interval_s
            return dataclasses.replace(episode, frames=recording.frames(interval_s))
        return episode

    def _decisions(self, paths: Sequence[Path]) -> tuple[InferenceRecord, ...]:
        """Return the decisions of a drive; a log that is not whole is named."""
        for path in paths:
            try:
                return read_decisions(path)
            except (OSError, documents.MalformedError, BrokenRecordingError) as error:
                self.broken[str(path)] = str(error)
        return ()

    def _read(self, path: Path) -> RecordedRoute | None:
        """Return a recording; one that is not whole is named."""
        try:
            raw = documents.from_json(documents.content(path), finite=False)
            return read_recording(raw)
        except OSError as error:
            self.broken[str(path)] = str(error.strerror)
        except (documents.MalformedError, BrokenRecordingError) as error:
            self.broken[str(path)] = str(error)
        return None


def _lowest_first(record: RouteRecord) -> tuple[float, bool, str]:
    given = record.episode.given
    composed = given.composed_percent if given else 0.0
    return composed, record.episode.succeeded, record.content
