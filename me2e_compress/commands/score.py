"""Score existing results, of one folder or of several, of real runs too."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress.base.display import (
    Table,
    format_number,
    join_names,
    missing_note,
    table,
)
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.options import check_number
from me2e_compress.commands.result import Result, View
from me2e_compress.commands.score_eer import EerScores, estimate_cells, score_eer
from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)
from me2e_compress.evaluators.bench2drive.result_files import holds_records
from me2e_compress.evaluators.results import MANIFEST, ResultsFolder
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.deadlines import Deadlines, charged, deadlines_table
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import (
    LeaderboardScores,
    Quotients,
    Scores,
    leaderboard_scores,
)

_NAMED = 5


@dataclasses.dataclass(frozen=True)
class RealRun:
    """A real run, scored."""

    collected: CollectedResults
    scores: Scores  # scores as of any other run, with Bench2Drive's rules of abilities
    # scores as the leaderboard and Bench2Drive's tools compute them
    leaderboard: LeaderboardScores

    def tables(self, name: str) -> tuple[Table, ...]:
        """Return the records, and the scores as given and as computed.

        Each figure is shown over the whole set, and over what was driven.
        """
        collected, off_rate = self.collected, self.collected.off_rate
        broken, lists = tuple(collected.broken), self._route_lists()
        counts = [
            ("evaluated", "", str(len(collected.episodes))),
            *((key, join_names(ids), str(len(ids))) for key, ids in lists.items()),
            ("not at 20 Hz", join_names(tuple(off_rate)), str(len(off_rate))),
            ("unfinished files", "", str(len(collected.unfinished))),
            ("broken", join_names(broken), str(len(broken))),
        ]
        # not every figure is both given by the simulator and computed here
        board = self.leaderboard
        figures = [
            ("driving score", "driving_score", "%"),
            ("success rate", "success_rate", "%"),
            ("route completion", "completion", "%"),
            ("infraction penalty", "penalty", "ratio"),
        ]
        rows = list[tuple[str, ...]]()
        for label, key, unit in figures:
            both = [
                each.get(key, Quotients()) for each in (board.given, board.computed)
            ]
            if unit == "%":  # a missing route has no penalty
                values = [format_number(each.set, ".4f") for each in both]
                rows.append((label, "set", *values, str(board.set_size), unit))
            values = [format_number(each.driven, ".4f") for each in both]
            rows.append((label, "driven", *values, str(board.driven), unit))
        real = f"{name}: real runs, Bench2Drive's routes"
        words = "given by the simulator, and computed with Bench2Drive's penalties"
        columns = ("score", "over", "given", "computed", "n", "unit")
        return (
            table(
                f"{real} {collected.route_set or 'of no known set'}",
                ("records", "which", "n"),
                counts,
                words=2,
            ),
            table(words, columns, rows, words=2),
        )

    def alerts(self, name: str) -> Iterator[str]:
        """Yield warnings, one line each."""
        collected = self.collected
        if collected.route_set is None:
            yield f"{name}: its routes are of no set of Bench2Drive that is known"
        doubtful = {*collected.foreign, *collected.contradictory, *collected.off_rate}
        routes = f"of {len(collected.episodes)} routes do not count as they should"
        files = "files or records are broken and left out"
        for count, what in ((len(doubtful), routes), (len(collected.broken), files)):
            if count:
                yield f"{name}: {count} {what}: see the table of records, or --json"
        yield from collected.notes[:_NAMED]

    def to_json(self) -> dict[str, object]:
        """Return scores, quotients, and every route that was named."""
        collected = self.collected
        return {
            **self.scores.to_json(),
            "leaderboard": {
                "route_set": collected.route_set,
                "set_size": self.leaderboard.set_size,
                "given": self.leaderboard.given,
                "computed": self.leaderboard.computed,
            },
            "records": {
                "evaluated": len(collected.episodes),
                **self._route_lists(),
                "unfinished": collected.unfinished,
                "broken": collected.broken,
                "intervals_s": collected.off_rate,
            },
        }

    def _route_lists(self) -> dict[str, Sequence[str]]:
        names = (
            *("crashed", "missing", "foreign", "repeated", "rerun"),
            *("contradictory", "unrecorded"),
        )
        return {name: getattr(self.collected, name) for name in names}


def score_real_run(
    path: Path, metric_folder: Path | None = None, routes: Path | None = None
) -> RealRun:
    """Read and score the results of a real run.

    `metric_folder` holds recordings (``metric_info.json``) that do not lie below that
    of the results; `routes` is the routes file of a set of one's own.
    """
    collected = Bench2DriveResults(path, metric_folder, routes).collect()
    episodes = collected.episodes
    set_size = collected.set_size * collected.repetitions
    return RealRun(
        collected,
        metrics.score(episodes, set_size),
        leaderboard_scores(episodes, set_size),
    )


@dataclasses.dataclass(frozen=True, repr=False)
class ScoreResult(Result):
    """Scores by folder."""

    scores: Mapping[str, Scores]  # in the order in which the folders were named
    # details of the folders that hold real runs
    real: Mapping[str, RealRun] = dataclasses.field(default_factory=dict)
    # EER_AV of all of them together; None where it was not asked for
    eer: EerScores | None = None
    # decision times against a budget, of folders whose decisions cost time
    late: Mapping[str, Deadlines] = dataclasses.field(default_factory=dict)

    def view(self) -> View:
        """Return a table a folder, records of real runs, EER_AV and its order.

        Alerts are failures that ended routes, and wrong records of real runs.
        """
        tables, alerts = list[Table](), list[str]()
        for name, scores in self.scores.items():
            if name in self.real:
                tables += self.real[name].tables(name)
            tables.append(scores_table(name, scores))
            if name in self.late:
                tables.append(deadlines_table(name, self.late[name]))
            if scores.failed:
                alerts.append(f"{name}: {scores.failed}")
        headline = "; ".join(
            f"{name}: {driving_score(scores)}" for name, scores in self.scores.items()
        )
        real = [line for name, each in self.real.items() for line in each.alerts(name)]
        eer = self.eer
        return View(
            headline,
            (*tables, *(() if eer is None else eer.tables())),
            () if eer is None else eer.lines(),
            (*alerts, *real),
        )

    def to_json(self) -> object:
        """Return the scores of every folder, and EER_AV of all together."""
        collected = [
            {
                "results": name,
                **self.real.get(name, scores).to_json(),
                "deadlines": self.late.get(name),
            }
            for name, scores in self.scores.items()
        ]
        return {"folders": collected, "eer": self.eer}


def score(
    *results: str | Path,
    listener: Listener = SILENT,
    real_metrics: str | Path | None = None,
    joules: Mapping[str, str | Path | float] | None = None,
    budget_ms: float = BUDGET_MS,
) -> ScoreResult:
    """Score the episodes in folders that ``evaluate`` or real Bench2Drive runs left.

    The listener is told of damaged files, which are left out. With `joules`, a number
    or a file by folder, EER_AV of all folders together is scored too. `real_metrics` is
    a folder of recordings of real runs (``metric_info.json``) that do not lie below
    their results. An ``.xml`` among the folders is the routes file of the set that real
    runs are of.

    Raises:
        EvaluationError: A folder holds no results, or EER_AV cannot compare them.
        EnergyError: A file of joules is not usable.
        RecipeError: The budget is not positive.
    """
    check_number("--budget-ms", budget_ms)
    scores, runs = dict[str, Scores](), dict[str, RealRun]()
    driven, measured = dict[str, Sequence[Episode]](), dict[str, int | None]()
    named = [Path(each) for each in results if Path(each).suffix == ".xml"]
    if len(named) > 1:
        raise EvaluationError(f"{named[1]}: one routes file names the set")
    # our own results have a manifest; anything else must be a real run
    for path in (Path(each) for each in results if Path(each) not in named):
        if (path / MANIFEST).exists():
            folder = ResultsFolder.open(path)
            driven[str(path)] = _episodes(folder, listener)
            scores[str(path)] = metrics.score(driven[str(path)], folder.set_size)
            measured[str(path)] = folder.measured
            continue
        if not path.exists():
            raise EvaluationError(f"{path}: no such folder")
        if real_metrics is None and not holds_records(path):
            raise EvaluationError(
                f"{path}: not a results folder: it holds neither {MANIFEST} nor "
                "records of a leaderboard"
            )
        recordings = None if real_metrics is None else Path(real_metrics)
        run = score_real_run(path, recordings, *named)
        scores[str(path)], runs[str(path)] = run.scores, run
        driven[str(path)] = run.collected.episodes
    # it would be ignored without a word
    if real_metrics is not None and not runs:
        raise EvaluationError(
            f"{', '.join(scores)}: no results of a real run, which --metrics is about"
        )
    if named and not runs:
        raise EvaluationError(f"{named[0]}: it names the set of real runs: give one")
    # folders whose decisions cost nothing have no deadlines
    late = {
        name: deadlines
        for name, episodes in driven.items()
        if (deadlines := charged(episodes, budget_ms, measured.get(name))) is not None
    }
    return ScoreResult(scores, runs, score_eer(driven, joules or {}), late)


def _episodes(folder: ResultsFolder, listener: Listener) -> tuple[Episode, ...]:
    """Return a folder's episodes; warn of damaged files."""
    episodes = tuple(folder.episodes().values())
    for file, reason in folder.corrupt.items():
        listener.on_warning(f"{file}: {reason}: left out")
    return episodes


def driving_score(scores: Scores) -> str:
    """Return driving score and room kept with intervals, and the number of routes."""
    score = scores.driving_score
    routes = f"{scores.routes} of {scores.expected} routes"
    if score.value is None:
        return f"driving score not measured ({score.measure.reason}); {routes}"
    room = scores.safety.room_kept
    room_text = "" if room.value is None else f", room kept {_interval(room)} %"
    return f"driving score {_interval(score)}{room_text}; {routes}"


def _interval(estimate: Estimate) -> str:
    low, high = format_number(estimate.low, ".1f"), format_number(estimate.high, ".1f")
    return f"{format_number(estimate.value, '.1f')} ({low} to {high})"


def scores_table(name: str, scores: Scores) -> Table:
    """Return every score with its unit, its interval and its number of routes."""
    routes = f"{scores.routes} of {scores.expected} routes"
    partial = ", PARTIAL: no comparison with a whole set" if scores.partial else ""
    rows = list[tuple[str, ...]]()
    for label, estimate in _each(scores):
        unit = estimate.measure.unit
        cells = estimate_cells(estimate, ".2f" if unit == "%" else ".3f")
        rows.append((label, *cells, unit))
    columns = ("score", "mean", "95 %", "95 %, other types", "n", "unit")
    why = {label: e.measure.reason for label, e in _each(scores) if e.value is None}
    return table(f"{name}: {routes}{partial}", columns, rows, missing_note(why))


def _each(scores: Scores) -> Iterator[tuple[str, Estimate]]:
    yield "driving score", scores.driving_score
    yield "room kept", scores.safety.room_kept
    yield "success rate", scores.success_rate
    yield "efficiency", scores.efficiency
    yield "Bench2Drive's efficiency", scores.bench2drive_efficiency
    yield "comfort", scores.comfort
    yield "Bench2Drive's smoothness", scores.bench2drive_smoothness
    yield "abilities, mean", scores.abilities
    yield from ((f"  {name}", rate) for name, rate in scores.each_ability.items())
    yield "frames with TTC below 1.5 s", scores.safety.ttc_exposure
    yield "smallest TTC", scores.safety.smallest_ttc
    yield "smallest PET", scores.safety.smallest_pet
    yield "smallest distance", scores.safety.smallest_distance
    yield "at-fault collisions", scores.safety.at_fault_collisions
