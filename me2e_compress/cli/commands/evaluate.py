"""``me2e-compress evaluate``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show, tell
from me2e_compress.runtime.providers import Provider, provider_named
from me2e_compress.workflows import evaluate as workflow
from me2e_compress.workflows.check_model import check_model

Policy = Annotated[
    str | None,
    typer.Argument(help="M.onnx, highway, expert, onnx{path=M.onnx,...}; see list"),
]
Evaluator = Annotated[
    str, typer.Option(help="who drives it: highway, NAME{option=value}, or see list")
]
Output = Annotated[
    Path | None, typer.Option("-o", "--output", help="the results folder")
]
Check = Annotated[
    bool,
    typer.Option("--check", help="say what fits and what is missing, drive nothing"),
]
Latency = Annotated[
    str, typer.Option(help="none, fps:F, trace:FILE, measured, or see list")
]
DriveOn = Annotated[
    bool, typer.Option("--drive-on", help="go on after a collision, as Bench2Drive")
]
Weather = Annotated[str, typer.Option(help="fog_m=80,night=0.5 ...")]
Render = Annotated[str | None, typer.Option(help="draw this route as GIF and PNG")]


def evaluate(
    policy: Policy = None,
    output: Output = None,
    check: Check = False,
    routes: given.Routes = "all",
    latency: Latency = "none",
    seed: given.Seed = 0,
    workers: given.Workers = 1,
    adapter: given.Adapter = None,
    module_map: given.ModuleMap = None,
    weather: Weather = "",
    drive_on: DriveOn = False,
    engine: given.Engine = "local",
    render: Render = None,
    evaluator: Evaluator = "highway",
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Drive a policy over routes of highway-env; run it again to go on.

    Another evaluator takes options of its own; --evaluator and --force alone are
    for all. --check looks at POLICY, --adapter, --map and --provider alone; 1 if it
    could not drive.
    """
    runs = provider_named(provider)
    # --check drives nothing, and needs no folder
    if check:
        _check(policy, adapter, module_map, runs)
        return
    if output is None:
        raise typer.BadParameter("driving needs -o RESULTS/", param_hint="-o")
    engine_name, address = given.engine_and_address(engine)
    options = workflow.EvaluateOptions(
        routes=routes, latency=latency, seed=seed, workers=workers,
        adapter=adapter, module_map=module_map, weather=weather, drive_on=drive_on,
        engine=engine_name, address=address, render=render, provider=runs, force=force,
        evaluator=evaluator,
    )  # fmt: skip
    with listening() as listener:
        found = workflow.evaluate(policy, output, options, listener)
    show(found)
    for file in found.pictures:
        tell(f"wrote {file}")


def _check(
    policy: str | None, adapter: Path | None, module_map: str | None, runs: Provider
) -> None:
    if policy is None:
        raise typer.BadParameter("--check needs a policy", param_hint="POLICY")
    with listening() as listener:
        found = check_model(policy, adapter, runs, listener, module_map)
    show(found)
    found.check()
