"""``me2e-compress demo``."""

import time
from pathlib import Path
from typing import Annotated, Literal

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, say, show
from me2e_compress.cli.verbosity import is_json, is_verbose
from me2e_compress.extras import need_extra
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows.demo_result import DemoResult, figure
from me2e_compress.workflows.demo_stack import StackDemo
from me2e_compress.workflows.result import Result
from me2e_compress.zoo.shipped import SHIPPED

Output = Annotated[
    Path, typer.Option("-o", "--output", "--out", help="the folder to write")
]
Stack = Annotated[
    Literal["highway", "vad-tiny"],
    typer.Option(help="the trained driver, or a stack of published size"),
]
Recipe = Annotated[str, typer.Option("-r", "--recipe", "--scheme", help=given.RECIPE)]
Routes = Annotated[str, typer.Option(help=f"{given.ROUTES}; highway")]


def demo(
    output: Output = Path("out"),
    stack: Stack = "highway",
    recipe: Recipe = "full-fused",
    routes: Routes = "5",
    workers: given.Workers = 2,
    provider: given.Provider = "cpu",
    plugins: given.Plugins = None,
    force: given.Force = False,
) -> None:
    """Run the main job on what ships: compress, verify, compare, drive, report.

    The trained driver is compressed and drives before and after; vad-tiny, at its
    published size and with random weights, is compressed, compared and timed.
    """
    # the trained driver drives, other stacks are only timed
    runs = provider_named(provider, plugins or ())
    if stack in SHIPPED:
        need_extra("highway", "driving in the demo")
        from me2e_compress.study.demo import DriverDemo

        driver = stack, output, recipe, runs, force
        steps = DriverDemo(*driver, routes, workers).steps
    else:
        steps = StackDemo(stack, output, recipe, runs, force).steps
    # each step says what it found as soon as it is done
    output.mkdir(parents=True, exist_ok=True)
    found = dict[str, Result]()
    for name, step in steps.items():
        begun = time.monotonic()
        with listening() as listener:
            found[name] = step(listener)
        if not is_json():
            seconds = time.monotonic() - begun
            say(f"{name:<10}{seconds:4.0f} s   {figure(found[name])}")
            if is_verbose():
                show(found[name])
    # with -v every step was shown in full already
    whole = DemoResult(found)
    if is_json() or not is_verbose():
        show(whole)
