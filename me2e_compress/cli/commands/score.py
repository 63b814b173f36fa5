"""``me2e-compress score``."""

from pathlib import Path
from typing import Annotated, cast

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.metrics.abilities import Rules
from me2e_compress.metrics.deadlines import BUDGET_MS
from me2e_compress.metrics.leaderboard_scores import Version
from me2e_compress.workflows import score as workflow
from me2e_compress.workflows.score_bench2drive import Bench2DriveOptions
from me2e_compress.workflows.score_eer import EerOptions, joules_named

Metrics = Annotated[
    Path | None, typer.Option(help="a folder of metric_info.json apart from RESULTS")
]
Junctions = Annotated[
    Path | None, typer.Option(help="JSON: where each route passes its junction")
]
AbilityRules = Annotated[
    str | None, typer.Option("--abilities", help="rules of abilities: 0.0.3 or 0.0.4")
]
Penalties = Annotated[
    str | None, typer.Option(help="penalties of infractions: b2d, 1.0, 2.0 or 2.1")
]
Joules = Annotated[
    list[str] | None,
    typer.Option(help="NAME=JOULES or NAME=FILE: of an inference; gives EER_AV"),
]
Weights = Annotated[
    Path | None,
    typer.Option(help="file of weights: of EER_AV, as --save-weights wrote them"),
]
SaveWeights = Annotated[Path | None, typer.Option(help="JSON of the weights of EER_AV")]


def score(
    results: Annotated[
        list[Path], typer.Argument(help="folders of results, ours or Bench2Drive's")
    ],
    metrics: Metrics = None,
    junctions: Junctions = None,
    rules: AbilityRules = None,
    penalties: Penalties = None,
    joules: Joules = None,
    weights: Weights = None,
    save_weights: SaveWeights = None,
    budget_ms: given.Budget = BUDGET_MS,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities.

    With --joules also EER_AV, which compares all folders. The other
    options but --budget-ms and --json are about results of real runs in CARLA.
    """
    # options of real runs are passed on only if one was given
    options = Bench2DriveOptions(
        metrics,
        junctions,
        cast("Rules | None", rules),
        cast("Version", penalties or "b2d"),
    )
    asked = any(each is not None for each in (metrics, junctions, rules, penalties))
    with listening() as listener:
        found = workflow.score(
            *results,
            listener=listener,
            real=options if asked else None,
            eer=EerOptions(joules_named(joules or ()), weights, save_weights),
            budget_ms=budget_ms,
        )
    show(found)
