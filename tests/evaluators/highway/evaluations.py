"""Evaluations of a blind driver on the routes that are short."""

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from me2e_compress.base.listener import SILENT, Listener
from me2e_compress.driving.latency import TraceLatency
from me2e_compress.driving.policies import Driver
from me2e_compress.evaluators import Drive
from me2e_compress.evaluators.contract import Engine
from me2e_compress.evaluators.highway.evaluator import Highway
from me2e_compress.evaluators.results import drive_routes
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import Route
from models.driver.expert.blind import BlindDriver
from tests.evaluators.highway.drivers import ROUTES

BLIND = BlindDriver()
TRACED = Drive(TraceLatency((30_000, 170_000, 320_000)))


def driven(
    folder: Path,
    routes: Sequence[Route] = ROUTES,
    policy: Driver = BLIND,
    drive: Drive = TRACED,
    engine: Engine | None = None,
    listener: Listener = SILENT,
) -> tuple[Episode, ...]:
    asked = replace(drive, routes=routes, set_size=220, engine=engine)
    return drive_routes(Highway(), policy, asked, folder, listener)


def made_by(routes: Sequence[Route] = ROUTES, drive: Drive = TRACED) -> dict[str, Any]:
    asked = replace(drive, routes=routes, set_size=220)
    return Highway().made_by(BLIND, asked) | {"routes": [route.id for route in routes]}
