"""Closed-loop scores between the rounds."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from me2e_compress.base.listener import Listener
from me2e_compress.driving.latency import LatencySource
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.highway.drivers import OnnxDriver
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.highway.evaluator import Highway
from me2e_compress.evaluators.results import drive_routes
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores, score
from me2e_compress.simulator.routes import (
    SCENARIO_ABILITIES,
    Route,
    load_routes,
    pick_routes,
)
from models.driver.admission import make_routes
from models.driver.curriculum import Trial
from models.driver.episodes.collection import refuse_shipped

OnDone = Callable[[int, int], None]


def routes_of(
    what: Trial, path: Path, workers: int, on_done: OnDone
) -> tuple[Route, ...]:
    """Return the routes of a trial, from its file once they were found.

    An interrupted search goes on where it was: it takes hours.

    Args:
        what: the trial.
        path: their manifest; written if it is not there.
        workers: processes.
        on_done: called with the types done and their total.

    Raises:
        TrainingError: one of them is a route that ships: those are for evaluation.
        EvaluationError: a type has no such routes, or the manifest is not one.
    """
    if not path.exists():
        types = what.scenarios or tuple(SCENARIO_ABILITIES)
        variants = -(-what.routes // len(types))
        make_routes(path, what.seed, types, variants, workers, on_done)
    found = load_routes(path)
    refuse_shipped("trial", what.seed, [(e.scenario, e.seed) for e in found])
    return pick_routes(found, str(what.routes))


def drive(
    driver: Path,
    routes: tuple[Route, ...],
    folder: Path,
    workers: int,
    on_done: OnDone,
    latency: LatencySource,
) -> Scores:
    """Drive a trial, or what is left of it.

    Args:
        driver: the ``.onnx``.
        routes: of the trial.
        folder: for the results.
        workers: processes.
        on_done: called with the routes done and their total.
        latency: what a decision costs.

    Raises:
        EvaluationError: the folder is of another driver or latency, or a process was
            killed.
    """
    listener = Listener(lambda _stage, done, total, _words: on_done(done, total))
    drive = Drive(
        latency, routes=routes, set_size=len(routes), engine=LocalEngine(workers)
    )
    who = OnnxDriver(driver)
    return score(drive_routes(Highway(), who, drive, folder, listener), len(routes))


def row_of(scores: Scores) -> dict[str, Any]:
    """Return the log's row: driving score and success rate, percent, 95 % intervals."""
    return {
        "routes": scores.routes,
        "driving_score_percent": _brief(scores.driving_score),
        "success_rate_percent": _brief(scores.success_rate),
    }


def _brief(estimate: Estimate) -> list[float | None]:
    """Return mean, lower and upper bound."""
    numbers = (estimate.value, estimate.low, estimate.high)
    return [None if number is None else round(number, 2) for number in numbers]
