"""A whole evaluation: independent routes, resumable, reproducible byte by byte."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar

from me2e_compress.driving.policies import opened
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.durations import longest_first
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.evaluators.highway.results import ResultsFolder, fingerprint
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.metrics.driving_score import route_score
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import Route


@dataclass(frozen=True)
class DrivingProgress:
    """Progress of an evaluation; scores are means in percent, None before the first."""

    done: int
    total: int
    driving_score: float | None
    success_rate: float | None


@dataclass(frozen=True)
class HighwayEvaluator:
    """Drives routes of highway-env and keeps the episodes in a folder.

    Running it again with the same folder drives what is missing. The files do not
    depend on the number of workers, the engine or the clock, unless latency is measured
    during the run. ``on_progress`` is called at the start and after every route.
    """

    name: ClassVar[str] = "highway"
    job: Job
    routes: tuple[Route, ...]
    folder: Path
    set_size: int
    engine: Engine = field(default_factory=LocalEngine)
    on_progress: Callable[[DrivingProgress], None] = lambda progress: None
    on_warning: Callable[[str], None] = lambda line: None

    def episodes(self) -> Iterator[Episode]:
        """Drive what is missing, then yield all routes in the order given.

        Raises:
            EvaluationError: The policy cannot be opened, the folder belongs to another
                evaluation or cannot be written, or a process was killed.
        """
        yield from self.some(self.routes)

    def some(self, routes: Sequence[Route]) -> Iterator[Episode]:
        """Drive what is missing of some of the evaluator's routes, then yield these.

        The folder belongs to all routes: the others may be driven later. It raises as
        :meth:`episodes` does.
        """
        if not routes:
            raise EvaluationError("there is no route to drive")
        # fail early on a policy or folder that cannot be used
        opened(self.job.driver)
        made_by = fingerprint(self.job, self.routes, self.set_size)
        measured = self.job.conditions.latency.measured
        folder = ResultsFolder.create(self.folder, made_by, measured)
        done = folder.episodes()
        for path, reason in folder.corrupt.items():
            self.on_warning(f"{path}: {reason}: driven again")
        # drive what is missing, in the order that wastes least time
        missing = [route for route in routes if route.id not in done]
        total = len(done) + len(missing)
        self.on_progress(progress_of(tuple(done.values()), total))
        for driven in self._engine.drive(self.job, longest_first(missing)):
            folder.save(driven)
            done[driven.episode.route] = driven.episode
            self.on_progress(progress_of(tuple(done.values()), total))
        yield from (done[route.id] for route in routes)

    @property
    def _engine(self) -> Engine:
        if not self.job.conditions.latency.measures:
            return self.engine
        if self.engine != LocalEngine(1):
            self.on_warning(
                "latency is measured here: routes driven in parallel would disturb "
                "it, so they are driven one at a time"
            )
        return LocalEngine(1)


def progress_of(episodes: Sequence[Episode], total: int) -> DrivingProgress:
    """Return the progress of the episodes so far."""
    if not episodes:
        return DrivingProgress(0, total, None, None)
    return DrivingProgress(
        len(episodes),
        total,
        sum(route_score(one).composed for one in episodes) / len(episodes),
        100.0 * sum(one.succeeded for one in episodes) / len(episodes),
    )
