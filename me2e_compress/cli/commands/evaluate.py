"""``me2e-compress evaluate``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from me2e_compress.cli.commands.score import scores_table
from me2e_compress.cli.console import console, errors, number, print_json, progress
from me2e_compress.cli.drivers import driver_of
from me2e_compress.cli.limits import check_number
from me2e_compress.cli.output import check_folder
from me2e_compress.driving.latency import parse_latency
from me2e_compress.evaluators.highway.drivers import image_size_of
from me2e_compress.evaluators.highway.evaluation_options import (
    engine_of,
    routes_named,
    weather_of,
)
from me2e_compress.evaluators.highway.evaluator import DrivingProgress, HighwayEvaluator
from me2e_compress.evaluators.highway.render import render
from me2e_compress.evaluators.highway.results import MANIFEST
from me2e_compress.evaluators.highway.runner import Conditions
from me2e_compress.evaluators.highway.worker import FRAME_LIMIT_S, Job
from me2e_compress.metrics.scores import Scores, score
from me2e_compress.simulator.routes import pick_routes


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
        weather_of(weather),
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
