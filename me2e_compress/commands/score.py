"""Score existing results, of one folder or of several, of real runs too."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress.base.display import (
    Table,
    format_number,
    format_significant,
    join_names,
    missing_note,
    plural,
    table,
)
from me2e_compress.base.errors import EvaluationError
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.options import Joules, check_number
from me2e_compress.commands.result import Result, View
from me2e_compress.evaluators.bench2drive.real_results import (
    Bench2DriveResults,
    CollectedResults,
)
from me2e_compress.evaluators.bench2drive.result_files import holds_records
from me2e_compress.evaluators.results import MANIFEST, ResultsFolder
from me2e_compress.metrics import BUDGET_MS
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.deadlines import (
    Deadlines,
    charged_deadlines,
    deadlines_table,
)
from me2e_compress.metrics.eer import MEASURES, EerResult, eer, route_measures
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_summary import RouteSummary
from me2e_compress.metrics.scores import (
    LeaderboardScores,
    Quotients,
    Scores,
    leaderboard_scores,
)
from me2e_compress.runtime.energy import EnergyResult

_NAMED = 5  # notes of a real run that are shown
UNITS = ("%", "%", "ratio", "J")  # of `MEASURES`
# Why a route is left out, listed beside the measures that may be missing
UNPAIRED = "a drive in each"


@dataclasses.dataclass(frozen=True)
class RealRun:
    """A real run, scored."""

    collected: CollectedResults
    scores: Scores  # scores as of any other run, with Bench2Drive's rules of abilities
    # scores as the leaderboard and Bench2Drive's tools compute them
    leaderboard: LeaderboardScores

    def tables(self, name: str) -> tuple[Table, ...]:
        """Return the records, and scores over the whole set and driven routes."""
        # Routes by what happened to their records
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
            both = [one.get(key, Quotients()) for one in (board.given, board.computed)]
            if unit == "%":  # a missing route has no penalty
                values = [format_number(quotient.set, ".4f") for quotient in both]
                rows.append((label, "set", *values, str(board.set_size), unit))
            values = [format_number(quotient.driven, ".4f") for quotient in both]
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
        collected = self.collected
        return {
            "crashed": collected.crashed,
            "missing": collected.missing,
            "foreign": collected.foreign,
            "repeated": collected.repeated,
            "rerun": collected.rerun,
            "contradictory": collected.contradictory,
            "unrecorded": collected.unrecorded,
        }


@dataclasses.dataclass(frozen=True, repr=False)
class ScoreResult(Result):
    """Scores by folder."""

    scores: Mapping[str, Scores]  # in the order in which the folders were named
    # details of the folders that hold real runs
    real: Mapping[str, RealRun] = dataclasses.field(default_factory=dict)
    # EER_AV of all of them together; None where it was not asked for
    eer: EerResult | None = None
    # decision times against a budget, of folders whose decisions cost time
    late: Mapping[str, Deadlines] = dataclasses.field(default_factory=dict)

    def view(self) -> View:
        """Return a table a folder, and EER_AV; alerts are failures and bad records."""
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
        for name, run in self.real.items():
            alerts += run.alerts(name)
        # EER_AV of all folders, and their order
        lines = list[str]()
        if self.eer is not None:
            tables += _eer_tables(self.eer)
            if self.eer.scale is not None:
                lines.append(f"EER_AV, best first: {', '.join(self.eer.ranking)}")
        return View(headline, tables, lines, alerts)

    def to_json(self) -> object:
        """Return the scores of every folder, and EER_AV of all together."""
        folders = [
            {
                "results": name,
                **self.real.get(name, scores).to_json(),
                "deadlines": self.late.get(name),
            }
            for name, scores in self.scores.items()
        ]
        if self.eer is None:
            return {"folders": folders, "eer": None}
        scale = None
        if self.eer.scale is not None:
            columns = dataclasses.asdict(self.eer.scale).items()
            scale = {name: dict(zip(MEASURES, e, strict=True)) for name, e in columns}
        eer = {"scores": self.eer.scores, "scale": scale, "left_out": self.eer.left_out}
        return {"folders": folders, "eer": eer}


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
    # A routes file is told from folders by its suffix
    scores, runs = dict[str, Scores](), dict[str, RealRun]()
    driven, measured = dict[str, Sequence[Episode]](), dict[str, int | None]()
    named = [path for path in map(Path, results) if path.suffix == ".xml"]
    if len(named) > 1:
        raise EvaluationError(f"{named[1]}: one routes file names the set")
    # Our own results have a manifest; anything else must be a real run
    for path in (path for path in map(Path, results) if path not in named):
        if (path / MANIFEST).exists():
            folder = ResultsFolder.open(path)
            driven[str(path)] = tuple(folder.episodes().values())
            for file, reason in folder.corrupt.items():
                listener.on_warning(f"{file}: {reason}: left out")
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
        collected = Bench2DriveResults(path, recordings, *named).collect()
        set_size = collected.set_size * collected.repetitions
        scores[str(path)] = metrics.score(collected.episodes, set_size)
        board = leaderboard_scores(collected.episodes, set_size)
        runs[str(path)] = RealRun(collected, scores[str(path)], board)
        driven[str(path)] = collected.episodes
    # it would be ignored without a word
    if real_metrics is not None and not runs:
        raise EvaluationError(
            f"{', '.join(scores)}: no results of a real run, which --metrics is about"
        )
    if named and not runs:
        raise EvaluationError(f"{named[0]}: it names the set of real runs: give one")
    # Folders whose decisions cost nothing have no deadlines
    late = dict[str, Deadlines]()
    for name, episodes in driven.items():
        charged = charged_deadlines(episodes, budget_ms, measured.get(name))
        if charged is not None:
            late[name] = charged
    return ScoreResult(scores, runs, score_eer(driven, joules or {}), late)


def score_eer(
    folders: Mapping[str, Sequence[Episode]], joules: Joules
) -> EerResult | None:
    """Return EER_AV of folders that hold the same routes; None without any joules.

    Only real runs may lack routes, on which CARLA crashed.

    Raises:
        EvaluationError: Routes differ, or joules are of no folder.
        EnergyError: A file of joules is not usable.
    """
    if not joules:
        return None
    # Routes that all folders hold, in the first folder's order
    by_route = {
        name: {episode.route: episode for episode in episodes}
        for name, episodes in folders.items()
    }
    first = next(iter(by_route.values()), {})
    shared = [route for route in first if all(route in e for e in by_route.values())]
    # Differing routes are an error unless every folder is a real run
    real = all(episode.given for one in folders.values() for episode in one)
    for name, own in by_route.items():
        unpaired = sorted({*own} ^ {*first})
        if unpaired and not (real and shared):
            raise EvaluationError(
                f"{name}: route {unpaired[0]} is in one of the folders only: EER_AV "
                "compares the same routes"
            )
    # Joules of an inference, as a number or of a file
    measured = dict[str, float | None]()
    for name, value in joules.items():
        fitting = [path for path in folders if name in (path, Path(path).name)]
        if len(fitting) != 1:
            raise EvaluationError(
                f"energy of {name}: {plural(len(fitting), 'folder')} of that name;"
                f" there are {', '.join(folders)}"
            )
        if isinstance(value, (str, Path)):
            measured[fitting[0]] = EnergyResult.load(Path(value)).j_per_frame
        elif 0.0 <= value < float("inf"):
            measured[fitting[0]] = value
        else:
            raise EvaluationError(
                f"energy of {name}: {value} is not a number of joules"
            )
    # Score the shared routes, and count the others
    variants = {
        name: route_measures(
            [RouteSummary.of(own[route]) for route in shared], measured.get(name)
        )
        for name, own in by_route.items()
    }
    result = eer(variants, types=[first[route].scenario for route in shared])
    every = {route for own in by_route.values() for route in own}
    if others := len(every) - len(shared):
        left_out = {UNPAIRED: others, **result.left_out}
        result = dataclasses.replace(result, left_out=left_out)
    return result


def _eer_tables(result: EerResult) -> Iterator[Table]:
    """Yield the scores of EER_AV, and the weights of its measures."""
    rows = [[n, *estimate_cells(score, ".2f")] for n, score in result.scores.items()]
    why = {
        f"EER_AV of {name}": score.measure.reason
        for name, score in result.scores.items()
        if score.value is None
    }
    columns = ("results", "EER_AV", "95 %", "95 %, other types", "n")
    yield table("Driving and energy, points", columns, rows, missing_note(why))
    if (scale := result.scale) is None:
        return
    # A measure is scaled so that its offset is 0 and offset plus span is 1
    rows = [
        [name, f"{weight:.3f}", *map(format_significant, (low, low + span)), unit]
        for name, weight, low, span, unit in zip(
            MEASURES, scale.weights, scale.offset, scale.span, UNITS, strict=True
        )
    ]
    missing = [f"{n} for want of {name}" for name, n in result.left_out.items()]
    note = f"Routes left out of all: {', '.join(missing)}." if missing else ""
    columns = ("measure", "weight", "0 is", "1 is", "unit")
    yield table("Weights by CRITIC, min-max", columns, rows, note)


def driving_score(scores: Scores) -> str:
    """Return driving score and room kept with intervals, and the number of routes."""
    score = scores.driving_score
    routes = f"{scores.routes} of {scores.expected} routes"
    if score.value is None:
        return f"driving score not measured ({score.measure.reason}); {routes}"
    room = scores.safety.room_kept
    room_text = "" if room.value is None else f", room kept {_interval_text(room)} %"
    return f"driving score {_interval_text(score)}{room_text}; {routes}"


def _interval_text(estimate: Estimate) -> str:
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
    # The driver's grade, then its parts, then near misses
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


def estimate_cells(estimate: Estimate, form: str) -> tuple[str, str, str, str]:
    """Return a value, its intervals and its number of routes, as a table shows them."""

    def between(low: float | None, high: float | None) -> str:
        if estimate.value is None or low is None or high is None:
            return "-"
        return f"{format_number(low, form)} to {format_number(high, form)}"

    here = between(estimate.low, estimate.high)
    anew = between(estimate.anew_low, estimate.anew_high)
    return format_number(estimate.value, form), here, anew, str(estimate.n)
