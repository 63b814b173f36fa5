"""``me2e-compress search``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.runtime.providers import provider_named
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows import search as workflow

MAX_JOULES = "most joules a frame, measured by a counter"
MaxMb = Annotated[float | None, typer.Option(help="most MB of weights")]
MaxMs = Annotated[
    float | None, typer.Option(help="most milliseconds a frame, on this CPU")
]
MaxJoules = Annotated[float | None, typer.Option(help=MAX_JOULES)]


def search(
    model: given.FloatModel,
    frames: given.Recording,
    output: given.RecipeOutput,
    max_mb: MaxMb = None,
    max_ms: MaxMs = None,
    max_joules: MaxJoules = None,
    adapter: given.Adapter = None,
    scheme: given.TrialScheme = "full",
    rules: given.TrialRules = "safe",
    target: given.TrialTarget = DEFAULT_TARGET,
    ranges: given.SavedRanges = None,
    module_map: given.ModuleMap = None,
    count: given.JudgedFrames = 4,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Find the scheme within the budgets that costs the plan least."""
    options = workflow.SearchOptions(
        max_mb=max_mb, max_ms=max_ms, max_joules=max_joules, scheme=scheme, rules=rules,
        target=target, ranges=ranges, module_map=module_map, count=count,
        force=force,
        provider=provider_named(provider), adapter=adapter,
    )  # fmt: skip
    with listening() as listener:
        found = workflow.search(model, frames, output, options, listener)
    show(found)
