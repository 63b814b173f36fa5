"""Evaluator that turns results of real CARLA runs into episodes."""

import dataclasses
import json
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar, Literal

from me2e_compress.driving.policies import Driver
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.recordings import (
    TICK_S,
    BrokenRecordingError,
    RecordedRoute,
    read_decisions,
    read_recording,
)
from me2e_compress.evaluators.bench2drive.result_files import (
    DriveRecordings,
    FoundFiles,
    ResultFile,
    RouteRecord,
    find_files,
)
from me2e_compress.evaluators.contract import Drive, Evaluator, Listener
from me2e_compress.metrics.episode import Episode, InferenceRecord
from me2e_compress.metrics.scores import FULL_SET
from me2e_compress.registry import documents

RouteSet = Literal["0.0.3", "0.0.4"]

_IDS = json.loads(Path(__file__).with_name("route_ids.json").read_bytes())
ROUTE_SETS: dict[RouteSet, frozenset[str]] = {
    version: frozenset(ids) for version, ids in _IDS.items()
}
"""The ids of the 220 routes of each version of Bench2Drive: those of
leaderboard/data/bench2drive220.xml and of bench2drive_0.0.4_val.xml, which share two.
The ten routes of "dev10" belong to the first."""


@dataclass(frozen=True)
class CollectedResults:
    """Every route once, in the order of numbers, and everything else that was found.

    Attributes:
        route_set: The version of Bench2Drive that the routes are from, if any.
        missing: Numbers of the set's routes without a record.
        repeated: Routes with identical records, as when a merged file lies next to its
            parts.
        rerun: Routes that crashed first and were driven again; the crash does not
            count.
        contradictory: Routes with different results; the lowest driving score counts.
        broken: Incomplete files and records, with the reason.
        unfinished: Results files of workers killed on their first route.
        unrecorded: Routes without a recording of the ego.
        off_rate: Seconds between two steps, for routes not recorded at the simulator's
            rate.
        repetitions: How often the set was driven: a leaderboard's ``--repetitions``.
        stated: Merged files that state scores of their own.
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
class Bench2DriveResults(Evaluator):
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

    def episodes(
        self, policy: Driver | None, drive: Drive, folder: Path, listener: Listener
    ) -> Iterator[Episode]:
        """Yield each route once, in the order of the routes' numbers.

        Raises:
            EvaluationError: There is no such folder, or no record below it.
        """
        yield from self.collect().episodes

    def collect(self) -> CollectedResults:
        """Read everything, and report what was found besides the episodes."""
        found = find_files(self.folder)
        if self.metrics is not None:
            apart = find_files(self.metrics)
            found.recordings += apart.recordings
            found.decisions += apart.decisions
        # links may lead to the same file twice
        found.recordings = _once(found.recordings)
        found.decisions = _once(found.decisions)
        if not any(file.records for file in found.results):
            why = "no results of a leaderboard below it"
            reports = [
                *(
                    f"no results of a leaderboard: {path.name}: {reason}"
                    for path, reason in found.broken.items()
                ),
                *(
                    f"no whole record: {file.path.name}: record {place}: {reason}"
                    for file in found.results
                    for place, reason in file.broken.items()
                ),
                *(f"no record: {file.path.name} holds none" for file in found.results),
            ]
            raise EvaluationError(f"{self.folder}: {[*reports, why][0]}")
        return _Collection(found).results()


def _once(paths: Sequence[Path]) -> list[Path]:
    return list({path.resolve(): path for path in paths}.values())


class _Collection:
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
        # episodes with frames and decisions
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
        # which routes of the set are missing, and which are foreign
        numbers = [each.number for each in records]
        best = max(ROUTE_SETS, key=lambda name: len(ROUTE_SETS[name] & set(numbers)))
        route_set = best if ROUTE_SETS[best] & set(numbers) else None
        whole = ROUTE_SETS[route_set] if route_set else frozenset[str]()
        return CollectedResults(
            episodes,
            route_set,
            crashed=tuple(each.episode.route for each in records if each.crashed),
            missing=tuple(sorted(whole - set(numbers), key=_by_number)),
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
        return sorted(chosen, key=lambda each: (_by_number(each.number), each.content))

    def _chosen(self, route: str, records: Sequence[RouteRecord]) -> RouteRecord:
        """Choose one record of a route, so that uncertainty never improves a result.

        A drive replaces a crash, as when Bench2Drive resumes. Among drives with
        different results the lowest score counts: taking the best would bias the
        evaluation.
        """
        # identical copies count once
        distinct = list({each.content: each for each in records}.values())
        if len(distinct) < len(records):
            self.repeated.append(route)
        # crashes count only without a drive
        drives = [each for each in distinct if not each.crashed]
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
        """Return the decisions of a drive; an incomplete log is reported."""
        for path in paths:
            try:
                return read_decisions(path)
            except (OSError, documents.MalformedError, BrokenRecordingError) as error:
                self.broken[str(path)] = str(error)
        return ()

    def _read(self, path: Path) -> RecordedRoute | None:
        """Return a recording; an incomplete one is reported."""
        try:
            raw = documents.from_json(documents.content(path), finite=False)
            return read_recording(raw)
        except OSError as error:
            self.broken[str(path)] = str(error.strerror)
        except (documents.MalformedError, BrokenRecordingError) as error:
            self.broken[str(path)] = str(error)
        return None


def _by_number(number: str) -> tuple[int, str]:
    """Return a sort key that orders routes by number."""
    return (int(number), "") if number.isascii() and number.isdecimal() else (0, number)
