"""``me2e-compress evaluate``."""

from pathlib import Path
from typing import Annotated

import typer
from pydantic import TypeAdapter, ValidationError
from rich.markup import escape

from me2e_compress.cli.commands.score import scores_table
from me2e_compress.cli.console import console, errors, number, print_json, progress
from me2e_compress.cli.drivers import driver_of
from me2e_compress.cli.limits import check_number
from me2e_compress.cli.output import check_folder
from me2e_compress.driving.latency import parse_latency
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.evaluators.highway.engine import Engine, LocalEngine
from me2e_compress.evaluators.highway.engine_ray import RayEngine
from me2e_compress.evaluators.highway.evaluator import DrivingProgress, HighwayEvaluator
from me2e_compress.evaluators.highway.render import render
from me2e_compress.evaluators.highway.results import MANIFEST
from me2e_compress.evaluators.highway.runner import Conditions
from me2e_compress.evaluators.highway.worker import FRAME_LIMIT_S, Job
from me2e_compress.metrics.scores import Scores, score
from me2e_compress.simulator.cameras import Weather
from me2e_compress.simulator.routes import Route, load_routes, pick_routes


def evaluate(
    policy: Annotated[
        str, typer.Argument(help="M.onnx, highway, expert, blind or blind:MPS")
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="the results folder")],
    routes: Annotated[
        str, typer.Option(help="all, a number, ID,ID or a file of routes")
    ] = "all",
    latency: Annotated[
        str, typer.Option(help="none, fps:F, trace:FILE or measured")
    ] = "none",
    latency_scale: Annotated[
        float, typer.Option(help="of a trace or a measurement")
    ] = 1.0,
    in_order: Annotated[bool, typer.Option(help="replay a trace in its order")] = False,
    seed: Annotated[int, typer.Option(min=0, help="of the draws from a trace")] = 0,
    workers: Annotated[int, typer.Option(min=1, help="routes at a time")] = 1,
    dt_ms: Annotated[float, typer.Option(help="step of the world")] = 50.0,
    adapter: Annotated[Path | None, typer.Option(help="TOML: adapts a model")] = None,
    weather: Annotated[str, typer.Option(help="fog_m=80,night=0.5,dropped=BACK")] = "",
    frame_limit: Annotated[
        float, typer.Option(help="seconds until a decision counts as hung")
    ] = FRAME_LIMIT_S,
    engine: Annotated[str, typer.Option(help="local or ray")] = "local",
    address: Annotated[str | None, typer.Option(help="of a Ray cluster")] = None,
    show: Annotated[
        str | None, typer.Option("--render", help="draw this route as GIF and PNG")
    ] = None,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Drive a policy over routes of highway-env; run it again to go on."""
    for option, value in (("--dt-ms", dt_ms), ("--frame-limit", frame_limit)):
        check_number(option, value)
    trace = latency.removeprefix("trace:")
    check_folder(output, (policy, routes, trace, adapter), (MANIFEST,))
    picked, set_size = routes_named(routes)
    shown = None if show is None else pick_routes(picked, show)
    driver = driver_of(policy, adapter)
    conditions = Conditions(
        parse_latency(latency, in_order=in_order, scale=latency_scale, seed=seed),
        round(dt_ms * 1000),
        image_size_of(driver.open()),
        _weather(weather),
    )
    job = Job(driver, conditions, frame_limit)
    with progress("evaluate") as advance:

        def on_progress(now: DrivingProgress) -> None:
            running = f"DS {number(now.driving_score, '.1f')}"
            running += f" SR {number(now.success_rate, '.1f')} %"
            advance(now.done, now.total, running)

        evaluator = HighwayEvaluator(
            job,
            picked,
            output,
            set_size,
            engine_of(engine, workers, address),
            on_progress,
            lambda line: errors.print(f"warning: {escape(line)}", soft_wrap=True),
        )
        scores = score(tuple(evaluator.episodes()), set_size)
    pictures = [file for route in shown or () for file in render(job, route, output)]
    _report(policy, scores, as_json)
    for file in pictures:
        errors.print(f"wrote {escape(str(file))}", soft_wrap=True)


def _report(policy: str, scores: Scores, as_json: bool) -> None:
    if as_json:
        print_json(scores.to_json())
    else:
        console.print(scores_table(policy, scores))


def routes_named(text: str) -> tuple[tuple[Route, ...], int]:
    """Return the routes asked for, and how many the set they are from has.

    Raises:
        EvaluationError: no such route, or no file of routes.
    """
    if text.endswith(".json"):
        routes = load_routes(Path(text))
        return routes, len(routes)
    shipped = load_routes()
    return pick_routes(shipped, text), len(shipped)


def engine_of(name: str, workers: int, address: str | None) -> Engine:
    """Give the engine that the words of the command line mean.

    Raises:
        EvaluationError: No such engine, or an address without a cluster.
    """
    if name == "local" and address is None:
        return LocalEngine(workers)
    if name == "ray":
        return RayEngine(workers, address)
    raise EvaluationError(
        f"engine {name!r} with address {address}: there are local, and ray with or "
        "without an address"
    )


def _weather(text: str) -> Weather:
    """Read ``option=value`` pairs; cameras that are dropped are joined by ``+``."""
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
