"""Evaluations of a blind driver on the routes that are short."""

from pathlib import Path

from me2e_compress.driving.latency import TraceLatency
from me2e_compress.evaluators.highway.conditions import Conditions
from me2e_compress.evaluators.highway.drivers import BlindDriver
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.evaluators.highway.evaluator import HighwayEvaluator
from me2e_compress.evaluators.highway.results import fingerprint
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.simulator.routes import Route
from tests.evaluators.highway.drivers import ROUTES

BLIND = Job(BlindDriver(), Conditions(TraceLatency((30_000, 170_000, 320_000))))


def evaluator(
    folder: Path, job: Job = BLIND, routes: tuple[Route, ...] = ROUTES, workers: int = 1
) -> HighwayEvaluator:
    return HighwayEvaluator(job, routes, folder, 220, LocalEngine(workers))


def made_by(one: HighwayEvaluator) -> dict[str, object]:
    return fingerprint(one.job, one.routes, one.set_size)
