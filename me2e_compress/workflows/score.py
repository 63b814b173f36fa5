"""Score existing results, of one folder or of several."""

import dataclasses
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.bench2drive.result_files import holds_records
from me2e_compress.evaluators.highway.results import MANIFEST, ResultsFolder
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.deadlines import BUDGET_MS, Deadlines, charged
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.route_scores import stood_most
from me2e_compress.metrics.scores import Scores
from me2e_compress.workflows.deadlines_table import check_budget, deadlines_table
from me2e_compress.workflows.listener import SILENT, Listener
from me2e_compress.workflows.result import Result, Table, not_measured, number, table
from me2e_compress.workflows.score_bench2drive import (
    STANDING,
    RealRun,
    score_real_run,
    some_of,
)
from me2e_compress.workflows.score_eer import (
    EerOptions,
    EerScores,
    estimate_cells,
    score_eer,
)


@dataclasses.dataclass(frozen=True, repr=False)
class ScoreResult(Result):
    """Scores by folder.

    Attributes:
        scores: in the order in which the folders were named.
        real: details of the folders that hold real runs.
        eer: EER_AV of all of them together; None where it was not asked for.
        late: decision times against a budget, of folders whose decisions cost time.
    """

    scores: Mapping[str, Scores]
    real: Mapping[str, RealRun] = dataclasses.field(default_factory=dict)
    eer: EerScores | None = None
    late: Mapping[str, Deadlines] = dataclasses.field(default_factory=dict)

    @property
    def headline(self) -> str:
        """The driving scores, and the room kept to others."""
        return "; ".join(
            f"{name}: {driving_score(scores)}" for name, scores in self.scores.items()
        )

    def lines(self) -> tuple[str, ...]:
        """Return whether the order by EER_AV depends on how it is normalized."""
        return () if self.eer is None else self.eer.lines()

    def tables(self) -> tuple[Table, ...]:
        """Return one table per folder, the records of real runs, and EER_AV."""
        found = [
            each
            for name, scores in self.scores.items()
            for each in self._of(name, scores)
        ]
        return (*found, *(() if self.eer is None else self.eer.tables()))

    def alerts(self) -> tuple[str, ...]:
        """Return failures that ended routes, and wrong records of real runs."""
        failed = [
            f"{name}: {each.failed}"
            for name, each in self.scores.items()
            if each.failed
        ]
        real = [line for name, each in self.real.items() for line in each.alerts(name)]
        return (*failed, *real)

    def to_json(self) -> object:
        """Return the scores of every folder, and EER_AV of all together."""
        found = [
            {
                "results": name,
                **self.real.get(name, scores).to_json(),
                "deadlines": self.late[name].to_json() if name in self.late else None,
            }
            for name, scores in self.scores.items()
        ]
        return {
            "folders": found,
            "eer": None if self.eer is None else self.eer.to_json(),
        }

    def _of(self, name: str, scores: Scores) -> tuple[Table, ...]:
        late = [deadlines_table(name, self.late[name])] if name in self.late else []
        if name not in self.real:
            return (scores_table(name, scores), *late)
        real = self.real[name]
        return (
            *real.tables(name),
            scores_table(name, scores),
            *late,
        )


def score(
    *results: str | Path,
    listener: Listener = SILENT,
    real_metrics: str | Path | None = None,
    eer: EerOptions | None = None,
    budget_ms: float = BUDGET_MS,
) -> ScoreResult:
    """Score the episodes in folders that ``evaluate`` or real Bench2Drive runs left.

    The listener is told of damaged files, which are left out; `eer` holds the folders'
    joules, for EER_AV of all of them together; `real_metrics` a folder of recordings of
    real runs (``metric_info.json``) that do not lie below their results.

    Raises:
        EvaluationError: A folder holds no results, EER_AV cannot compare the folders,
            or the budget is not positive.
        EnergyError: A file of joules is not usable.
    """
    check_budget(budget_ms)
    scores, runs = dict[str, Scores](), dict[str, RealRun]()
    driven, measured = dict[str, Sequence[Episode]](), dict[str, int | None]()
    # our own results have a manifest; anything else must be a real run
    for path in map(Path, results):
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
        apart = None if real_metrics is None else Path(real_metrics)
        run = score_real_run(path, apart)
        scores[str(path)], runs[str(path)] = run.scores, run
        driven[str(path)] = run.collected.episodes
    # it would be ignored without a word
    if real_metrics is not None and not runs:
        raise EvaluationError(
            f"{', '.join(scores)}: no results of a real run, which --metrics is about"
        )
    # folders whose decisions cost nothing have no deadlines
    late = {
        name: found
        for name, episodes in driven.items()
        if (found := charged(episodes, budget_ms, measured.get(name))) is not None
    }
    return ScoreResult(scores, runs, score_eer(driven, eer or EerOptions()), late)


def _episodes(folder: ResultsFolder, listener: Listener) -> tuple[Episode, ...]:
    """Return a folder's episodes; warn of damaged files and of an ego that stood."""
    episodes = tuple(folder.episodes().values())
    for file, reason in folder.corrupt.items():
        listener.on_warning(f"{file}: {reason}: left out")
    if stood := stood_most(episodes):
        listener.on_warning(f"{folder.path}: {STANDING}: {some_of(stood)}")
    return episodes


def driving_score(scores: Scores) -> str:
    """Return driving score and room kept with intervals, and the number of routes."""
    found = scores.driving_score
    routes = f"{scores.routes} of {scores.expected} routes"
    if found.value is None:
        return f"driving score not measured ({found.measure.reason}); {routes}"
    room = scores.safety.room_kept
    kept = "" if room.value is None else f", room kept {_between(room)} %"
    return f"driving score {_between(found)}{kept}; {routes}"


def _between(found: Estimate) -> str:
    low, high = number(found.low, ".1f"), number(found.high, ".1f")
    return f"{number(found.value, '.1f')} ({low} to {high})"


def scores_table(name: str, scores: Scores) -> Table:
    """Return every score with its unit, its interval and its number of routes."""
    routes = f"{scores.routes} of {scores.expected} routes"
    partial = ", PARTIAL: no comparison with a whole set" if scores.partial else ""
    rows = [(label, *_cells(estimate)) for label, estimate in _each(scores)]
    columns = ("score", "mean", "95 %", "95 %, other types", "n", "unit")
    why = {label: e.measure.reason for label, e in _each(scores) if e.value is None}
    return table(f"{name}: {routes}{partial}", columns, rows, not_measured(why))


def _each(scores: Scores) -> Iterator[tuple[str, Estimate]]:
    yield "driving score", scores.driving_score
    yield "room kept", scores.safety.room_kept
    yield "success rate", scores.success_rate
    yield "efficiency", scores.efficiency
    yield "Bench2Drive's efficiency", scores.bench2drive_efficiency
    yield "comfort", scores.comfort
    yield "comfort in motion", scores.comfort_in_motion
    yield "Bench2Drive's smoothness", scores.bench2drive_smoothness
    yield "abilities, mean", scores.abilities
    yield from ((f"  {name}", rate) for name, rate in scores.each_ability.items())
    yield "frames with TTC below 1.5 s", scores.safety.ttc_exposure
    yield "smallest TTC", scores.safety.smallest_ttc
    yield "smallest PET", scores.safety.smallest_pet
    yield "smallest distance", scores.safety.smallest_distance
    yield "at-fault collisions", scores.safety.at_fault_collisions


def _cells(estimate: Estimate) -> Sequence[str]:
    unit = estimate.measure.unit
    return *estimate_cells(estimate, ".2f" if unit == "%" else ".3f"), unit
