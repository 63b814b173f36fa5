"""A whole evaluation: independent routes, resumable, reproducible byte by byte."""

import functools
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import ClassVar

from me2e_compress.driving.latency import LatencySource, parse_latency
from me2e_compress.driving.policies import Driver, driver_named, opened
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import ConditionOptions
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine, RayEngine
from me2e_compress.evaluators.highway.results import ResultsFolder, fingerprint
from me2e_compress.evaluators.highway.worker import Job
from me2e_compress.extras import need_extra
from me2e_compress.metrics.episode import Episode
from me2e_compress.metrics.route_scores import route_score
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.simulator.routes import (
    EXPERT_S,
    Route,
    load_routes,
    pick_routes,
)


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
        if not self.routes:
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
        missing = [route for route in self.routes if route.id not in done]
        total = len(done) + len(missing)
        self.on_progress(progress_of(tuple(done.values()), total))
        for driven in self._engine.drive(self.job, longest_first(missing)):
            folder.save(driven)
            done[driven.episode.route] = driven.episode
            self.on_progress(progress_of(tuple(done.values()), total))
        yield from (done[route.id] for route in self.routes)

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


def longest_first(routes: Sequence[Route]) -> list[Route]:
    """Order routes by the typical duration of their type, longest first.

    A long route that starts last would keep all other workers waiting.
    """
    return sorted(routes, key=lambda route: (-EXPERT_S[route.scenario], route.id))


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


@dataclass(frozen=True, kw_only=True)
class DrivingOptions(ConditionOptions):
    """Which routes are driven, under which conditions and where, whatever drives them.

    Texts are read when they are first needed, and once.

    Attributes:
        routes: ``all``, a number, ``ID,ID`` or a file of routes.
        latency: what a decision costs: ``none``, ``fps:F``, ``trace:FILE``,
            ``measured``.
        seed: seed of the draws from a trace.
        workers: routes at a time.
        adapter: TOML file that adapts the model to the policy contract.
        engine: ``local``, processes of this machine, or ``ray``, a cluster.
        address: address of a running Ray cluster; None starts one.
        provider: what runs the model; policies other than graphs ignore it.
    """

    routes: str = "all"
    latency: str = "none"
    seed: int = 0
    workers: int = 1
    adapter: str | Path | None = None
    engine: str = "local"
    address: str | None = None
    provider: Provider = CPU

    @functools.cached_property
    def picked(self) -> tuple[tuple[Route, ...], int]:
        """The routes asked for, and the size of the set they are from.

        Raises:
            EvaluationError: There is no such route, or no file of routes.
        """
        return routes_named(self.routes)

    @functools.cached_property
    def source(self) -> LatencySource:
        """The latency of each decision.

        Raises:
            EvaluationError: There is no such source, or an option is invalid.
        """
        return parse_latency(self.latency, seed=self.seed)

    def driven_by(
        self,
        driver: Driver,
        folder: Path,
        on_progress: Callable[[DrivingProgress], None] = lambda progress: None,
        on_warning: Callable[[str], None] = lambda line: None,
    ) -> HighwayEvaluator:
        """Return the evaluator of a driver, whose results go to a folder.

        Raises:
            EvaluationError: An option is invalid, or the driver cannot be opened.
        """
        picked, set_size = self.picked
        conditions = replace(self.settings, latency=self.source)
        size = image_size_of(opened(driver))
        return HighwayEvaluator(
            Job(driver, replace(conditions, image_size=size)),
            picked,
            folder,
            set_size,
            engine_of(self.engine, self.workers, self.address),
            on_progress,
            on_warning,
        )


@dataclass(frozen=True)
class HighwayEvaluation(DrivingOptions):
    """Drive a policy over routes of highway-env, resuming an interrupted run.

    Attributes:
        policy: A policy by name, ``blind:8``, or the path of an ONNX file.
        folder: Where the results go.
    """

    name: ClassVar[str] = "highway"
    policy: str
    folder: Path

    def episodes(self) -> Iterator[Episode]:
        """Drive what is missing, then yield all routes in the order given.

        Raises:
            EvaluationError: An option is invalid, or see `HighwayEvaluator.episodes`.
        """
        yield from self.evaluator().episodes()

    def evaluator(self) -> HighwayEvaluator:
        """Build the evaluator of the policy, which is looked up by name.

        Raises:
            EvaluationError: An option is invalid.
            MissingExtraError: The extra ``highway`` is not installed.
        """
        need_extra("highway", "driving")
        driver = driver_named(self.policy, self.adapter)
        if isinstance(driver, OnnxDriver):
            driver = replace(driver, provider=self.provider)
        return self.driven_by(driver, self.folder)


def routes_named(text: str, beside: Path = Path()) -> tuple[tuple[Route, ...], int]:
    """Return the routes asked for, and the size of the set they are from.

    A file of routes is looked up in the folder ``beside``.

    Raises:
        EvaluationError: There is no such route, or no file of routes.
    """
    if text.endswith(".json"):
        routes = load_routes(beside / text)
        return routes, len(routes)
    shipped = load_routes()
    return pick_routes(shipped, text), len(shipped)


def engine_of(name: str, workers: int, address: str | None) -> Engine:
    """Return the engine of a name; only ``ray`` takes an address."""
    if name == "local" and address is None:
        return LocalEngine(workers)
    if name == "ray":
        return RayEngine(workers, address)
    raise EvaluationError(
        f"engine {name!r} with address {address}: there are local, and ray with or "
        "without an address"
    )
