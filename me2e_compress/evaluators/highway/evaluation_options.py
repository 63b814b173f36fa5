"""Options of an evaluation in highway-env."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import ClassVar

from pydantic import TypeAdapter, ValidationError

from me2e_compress.driving.latency import parse_latency
from me2e_compress.driving.policies import Driver, driver_named, opened
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.conditions import (
    Conditions,
    latency_model_named,
    step_us,
)
from me2e_compress.evaluators.highway.drivers import OnnxDriver, image_size_of
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.evaluators.highway.engine_ray import RayEngine
from me2e_compress.evaluators.highway.evaluator import DrivingProgress, HighwayEvaluator
from me2e_compress.evaluators.highway.worker import FRAME_LIMIT_S, Job
from me2e_compress.extras import need_extra
from me2e_compress.metrics.episode import Episode
from me2e_compress.simulator.routes import Route, load_routes, pick_routes
from me2e_compress.simulator.weather import Weather


@dataclass(frozen=True)
class HighwayEvaluation:
    """Drive a policy over routes of highway-env, resuming an interrupted run.

    Attributes:
        policy: A policy by name, ``blind:8``, or the path of an ONNX file.
        folder: Where the results go.
        routes: ``all``, a number, comma-separated ids, or a file of routes.
        latency: Latency of decisions: ``none``, ``fps:10``, ``trace:FILE``.
        latency_scale: Factor on a trace or a measurement.
        in_order: Replay a trace in its order.
        latency_model: ``drop`` decisions meanwhile, or ``fifo``: delay controls.
        seed: Seed of the draws from a trace.
        adapter: TOML file that adapts a model to the policy contract.
        dt_ms: Step of the world, milliseconds.
        weather: ``fog_m=80,night=0.5,dropped=BACK``; empty for a clear day.
        frame_limit_s: Seconds until a decision counts as hung.
        workers: Routes at a time.
        engine: ``local``, processes of this machine, or ``ray``, a cluster.
        address: Address of a running Ray cluster; None starts one.
        provider: What runs the model: ``cpu``, ``tensorrt{cache=engines}``.
    """

    name: ClassVar[str] = "highway"
    policy: str
    folder: Path
    routes: str = "all"
    latency: str = "none"
    latency_scale: float = 1.0
    in_order: bool = False
    latency_model: str = "drop"
    seed: int = 0
    adapter: Path | None = None
    dt_ms: float = 50.0
    weather: str = ""
    frame_limit_s: float = FRAME_LIMIT_S
    workers: int = 1
    engine: str = "local"
    address: str | None = None
    provider: str = "cpu"

    def episodes(self) -> Iterator[Episode]:
        """Drive what is missing, then yield all routes in the order given.

        Raises:
            EvaluationError: An option is invalid, or see `HighwayEvaluator.episodes`.
        """
        yield from self.evaluator().episodes()

    def evaluator(
        self,
        on_progress: Callable[[DrivingProgress], None] = lambda progress: None,
        on_warning: Callable[[str], None] = lambda line: None,
        driver: Driver | None = None,
    ) -> HighwayEvaluator:
        """Build the evaluator; without a driver, the policy is looked up by name."""
        need_extra("highway", "driving")
        # options become routes, driver and conditions
        picked, set_size = routes_named(self.routes)
        driver = driver or self._driver()
        latency = parse_latency(
            self.latency,
            in_order=self.in_order,
            scale=self.latency_scale,
            seed=self.seed,
        )
        conditions = Conditions(
            latency,
            step_us(self.dt_ms),
            image_size_of(opened(driver)),
            weather_of(self.weather),
            latency_model_named(self.latency_model),
        )
        return HighwayEvaluator(
            Job(driver, conditions, self.frame_limit_s),
            picked,
            self.folder,
            set_size,
            engine_of(self.engine, self.workers, self.address),
            on_progress,
            on_warning,
        )

    def _driver(self) -> Driver:
        found = driver_named(self.policy, self.adapter)
        if isinstance(found, OnnxDriver):
            return replace(found, provider=self.provider)
        return found


def routes_named(text: str) -> tuple[tuple[Route, ...], int]:
    """Return the routes asked for, and the size of the set they are from."""
    if text.endswith(".json"):
        routes = load_routes(Path(text))
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


def weather_of(text: str) -> Weather:
    """Read ``option=value`` pairs; dropped cameras are joined by ``+``."""
    options: dict[str, object] = {}
    for pair in filter(None, text.split(",")):
        name, _, value = pair.partition("=")
        options[name.strip()] = value.split("+") if name == "dropped" else value
    unknown = [name for name in options if name not in Weather.__dataclass_fields__]
    if unknown:
        raise EvaluationError(
            f"weather option {unknown[0]!r}: there are "
            f"{', '.join(Weather.__dataclass_fields__)}"
        )
    try:
        return TypeAdapter(Weather).validate_python(options)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        raise EvaluationError(
            f"weather option {first['loc'][0]}: {first['msg']}"
        ) from error
