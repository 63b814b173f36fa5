"""A course of training, from nothing to a driver: collect, train, drive, repeat."""

from collections.abc import Callable, Iterable
from dataclasses import asdict, dataclass
from pathlib import Path

from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.driving.latency import FixedLatency, LatencySource
from me2e_compress.graph import sha256_of
from me2e_compress.metrics.scores import Scores
from models.driver import trial
from models.driver.checkpoint import Start, TrainingCheckpoint, fit
from models.driver.curriculum import Course, Round, held_out_files
from models.driver.episodes import Collection, collect
from models.driver.log import Log
from models.driver.loop import train
from models.driver.network.config import HighwayConfig
from models.driver.network.stack import Highway, write_onnx
from models.driver.options import claim
from models.driver.process import LOG
from models.driver.stored_episode import samples_in

MANIFEST = "course.json"
NO_LATENCY = FixedLatency()


@dataclass(frozen=True)
class RoundResult:
    """The result of a round.

    Attributes:
        driver: the ``.onnx``.
        scores: over the routes of the course's trial.
        log: losses and scores, one JSON object a line.
    """

    driver: Path
    scores: Scores
    log: Path


def run(
    course: Course,
    folder: Path,
    workers: int,
    listener: Listener = SILENT,
    latency: LatencySource = NO_LATENCY,
) -> tuple[RoundResult, ...]:
    """Run the whole course, or what is left of it after an interruption.

    The same course gives the same bytes for the same number of workers, however often
    it was interrupted.

    Args:
        course: the rounds.
        folder: gets a folder a round: ``episodes/``, ``training-0/``, ``trial/``,
            ``driver.onnx``.
        workers: processes, for driving and for training.
        listener: is called with how far every part is.
        latency: what a decision costs in the trials.

    Returns:
        The result of each round; the last driver is the one that was asked for.

    Raises:
        TrainingError: the folder or episodes are of something else, an episode is
            damaged, or a part failed.
        EvaluationError: results of something else are in the way.
    """
    course = course.on(workers)
    claim(folder / MANIFEST, "course", asdict(course))
    course_run = _CourseRun(course, folder, workers, listener, latency)
    return tuple(
        course_run.run_round(number, each) for number, each in enumerate(course.rounds)
    )


class _CourseRun:
    """A course while it runs: what a round hands to the next."""

    def __init__(
        self,
        course: Course,
        folder: Path,
        workers: int,
        listener: Listener,
        latency: LatencySource,
    ) -> None:
        self.course, self.folder, self.workers = course, folder, workers
        self.listener, self.latency = listener, latency
        self.learned, self.held_out = list[Path](), list[Path]()
        self.start: Path | None = None
        self.driver: Path | None = None

    def run_round(self, number: int, each: Round) -> RoundResult:
        """Run one round."""
        place, label = self.folder / f"round-{number}", f"round {number}"
        # drive: the expert, later the last driver and the expert in turns (DAgger)
        files = self._collect(each, place / "episodes", label)
        if number == 0:
            self.held_out = held_out_files(files)
        fresh = [file for file in files if file not in self.held_out]
        self.learned += fresh * each.repeat
        # learn from everything collected so far, from the last weights on
        self.start, log = self._train(each, place, label)
        self.driver = place / "driver.onnx"
        if not self.driver.exists():
            write_onnx(load(self.start, self.course.config), self.driver)
        # drive routes that were never learned from, for the log
        scores = self._evaluate(self.driver, place / "trial", label)
        row = {"learned_frames": frames_in(self.learned), **trial.row_of(scores)}
        log.add("closed_loop", each.trainings[-1].steps, row)
        return RoundResult(self.driver, scores, log.path)

    def _collect(self, each: Round, folder: Path, label: str) -> list[Path]:
        student = None if each.expert_share == 1.0 else self.driver
        what = Collection(
            each.seed,
            each.variants,
            image_size=self.course.config.image_size,
            scenarios=each.scenarios,
            expert_share=each.expert_share,
            student=None if student is None else sha256_of(student),
        )
        on_done = self._progress(f"{label}: driving")
        collect(folder, what, student, self.workers, on_done)
        return episodes_in(folder)

    def _train(self, each: Round, place: Path, label: str) -> tuple[Path, Log]:
        """Run all stages and return the last one's checkpoint and log."""
        made, config = list[Path](), self.course.config
        for number, training in enumerate(each.trainings):
            on_done = self._progress(
                f"{label}: training {number + 1}/{len(each.trainings)}"
            )
            folder = place / f"training-{number}"
            files = (self.learned, self.held_out)
            start = made[-1] if made else self.start
            made.append(train(training, config, *files, start, folder, on_done))
            _hand_on(made[-1], needed=True)
        for begun_from in made[:-1]:
            _hand_on(begun_from, needed=False)
        return made[-1], Log(made[-1].with_name(LOG))

    def _evaluate(self, driver: Path, folder: Path, label: str) -> Scores:
        what, path = self.course.trial, self.folder / "trial.json"
        on_done = self._progress("finding routes for the trial")
        routes = trial.routes_of(what, path, self.workers, on_done)
        on_done = self._progress(f"{label}: driving the trial")
        return trial.drive(driver, routes, folder, self.workers, on_done, self.latency)

    def _progress(self, what: str) -> Callable[[int, int], None]:
        return lambda done, total: self.listener.on_progress(what, done, total, "")


def load(checkpoint: Path, config: HighwayConfig) -> Highway:
    """Return the driver of a checkpoint, with its averaged weights.

    Raises:
        TrainingError: it is not a checkpoint, or one of another model.
    """
    model = Highway(config)
    fit(model, Start.load(checkpoint).mean, checkpoint)
    return model.eval()


def _hand_on(checkpoint: Path, *, needed: bool) -> None:
    """Keep of a stage at its end what a later one needs, so that it can be kept."""
    found = TrainingCheckpoint.load(checkpoint)
    if found.optimizer or (found.mean and not needed):
        found.handed_on(needed=needed).save(checkpoint)


def episodes_in(folder: Path) -> list[Path]:
    """Return the episodes of a folder, in order, without drafts."""
    return sorted(
        file for file in folder.glob("*.npz") if not file.name.startswith(".")
    )


def frames_in(files: Iterable[Path]) -> int:
    """Return how many camera frames distinct episodes hold, six images each.

    Raises:
        TrainingError: a file is not an episode.
    """
    return sum(samples_in(file) for file in sorted(set(files)))
