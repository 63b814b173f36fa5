"""The driver, trained from nothing, and what came of it."""

import dataclasses
from pathlib import Path

from me2e_compress.base.display import Table, format_number, table
from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.commands.checks import check_folder, writing
from me2e_compress.commands.options import check_count
from me2e_compress.commands.result import Result
from me2e_compress.metrics.measure import Estimate
from models.driver.course import RoundResult, run
from models.driver.curriculum import FULL, FULL_LATENCY, SMALL, SMALL_LATENCY


@dataclasses.dataclass(frozen=True, repr=False)
class TrainResult(Result):
    """What came of every round.

    Attributes:
        rounds: the last one's driver is the one that was asked for.
    """

    rounds: tuple[RoundResult, ...]

    @property
    def headline(self) -> str:
        """The driver."""
        return f"wrote {self.rounds[-1].driver}"

    def lines(self) -> tuple[str, ...]:
        """Return driver and log."""
        return self.headline, f"its log is {self.rounds[-1].log}"

    def tables(self) -> tuple[Table, ...]:
        """Return how the driver of every round drives."""
        rows = [
            (
                str(which),
                str(each.scores.routes),
                _between(each.scores.driving_score),
                _between(each.scores.success_rate),
            )
            for which, each in enumerate(self.rounds)
        ]
        columns = ("round", "routes", "driving score, %", "success rate, %")
        return (table("driven on fresh routes after every round", columns, rows),)

    def to_json(self) -> object:
        """Return driver, log and scores of every round."""
        rounds = [
            {"driver": each.driver, "log": each.log, "scores": each.scores.to_json()}
            for each in self.rounds
        ]
        return {"rounds": rounds}


def train(
    output: str | Path,
    workers: int = 4,
    listener: Listener = SILENT,
    *,
    small: bool = False,
    seed: int = 0,
    overlook: float | None = None,
) -> TrainResult:
    """Train the driver ``highway``: collect, learn, drive, learn again (hours).

    Args:
        output: a folder; the same again resumes.
        workers: processes.
        listener: is called with progress and warnings.
        small: go through every part in a minute, and learn nothing.
        seed: of the first weights and of the samples' order, not of the routes.
        overlook: share of agents that the planner is not told of, see
            `models.driver.step.without_rivals`; None tells it all, but drops occupancy.

    Raises:
        TrainingError: the folder is of another course, the share is none, or a part
            failed.
        GraphError: the folder is a file.
    """
    output = Path(output)
    check_folder(output, ())
    check_count("--seed", seed)
    check_count("--workers", workers, least=1)
    course, latency = (SMALL, SMALL_LATENCY) if small else (FULL, FULL_LATENCY)
    course = course.seeded(seed)
    if overlook is not None:
        course = course.overlooking(overlook)
    with writing(folders=[output]):
        return TrainResult(run(course, output, workers, listener, latency))


def _between(estimate: Estimate) -> str:
    ends = (estimate.value, estimate.low, estimate.high)
    value, low, high = (format_number(each, ".1f") for each in ends)
    return f"{value} ({low} to {high})"
