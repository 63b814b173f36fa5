"""``me2e-compress lint``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.cli.verbosity import is_verbose
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import lint as workflow

TrtCheck = Annotated[
    bool, typer.Option("--trt-check", help="also parse and build it by TensorRT-RTX")
]
TargetVersion = Annotated[
    str | None, typer.Option(help="of tensorrt, as 10.13: refuses what came later")
]


def lint(
    model: given.Model,
    target: given.Target = None,
    trt_check: TrtCheck = False,
    target_version: TargetVersion = None,
    sm: Annotated[int, typer.Option(help="GPU generation that is built for")] = 86,
    provider: given.Provider = "cpu",
) -> None:
    """Check a graph for the runtime that will run it; exit code 1 if it refuses."""
    runs = provider_named(provider)
    options = workflow.LintOptions(target, trt_check, sm, runs, target_version)
    with listening() as listener:
        found = workflow.lint(model, options, listener)
    every = found.tables(shown=len(found.findings)) if is_verbose() else None
    show(found, every)
    found.check()
