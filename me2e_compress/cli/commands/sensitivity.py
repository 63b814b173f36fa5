"""``me2e-compress sensitivity``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.runtime.providers import provider_named
from me2e_compress.targets import DEFAULT_TARGET
from me2e_compress.workflows import sensitivity as workflow

Limit = Annotated[
    float,
    typer.Option(help="most loss of the recipe: metres of the plan, see below"),
]
NodeTrials = Annotated[
    int, typer.Option(min=0, help="most variants of the worst module's nodes; 0: none")
]


def sensitivity(
    model: given.FloatModel,
    frames: given.Recording,
    output: given.RecipeOutput,
    scheme: given.TrialScheme = "full",
    rules: given.TrialRules = "safe",
    target: given.TrialTarget = DEFAULT_TARGET,
    limit: Limit = 0.1,
    adapter: given.Adapter = None,
    node_trials: NodeTrials = 16,
    ranges: given.SavedRanges = None,
    module_map: given.ModuleMap = None,
    count: given.JudgedFrames = 4,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Measure what int8 costs module by module, and write a recipe within a limit.

    Halves of the worst module's nodes are tried next, to find those to blame.
    The loss is how far the plan moves, metres, mean over the frames; of a model
    whose plan is not known, the noise of its worst output relative to the signal.
    """
    options = workflow.SensitivityOptions(
        scheme=scheme, rules=rules, target=target, limit=limit,
        adapter=adapter, node_trials=node_trials, ranges=ranges, module_map=module_map,
        count=count, force=force, provider=provider_named(provider),
    )  # fmt: skip
    with listening() as listener:
        found = workflow.measure_sensitivity(model, frames, output, options, listener)
    show(found)
