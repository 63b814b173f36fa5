"""``me2e-compress score``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.metrics.deadlines import BUDGET_MS
from me2e_compress.workflows import score as workflow
from me2e_compress.workflows.score_eer import EerOptions, joules_named

Metrics = Annotated[
    Path | None, typer.Option(help="a folder of metric_info.json apart from RESULTS")
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
    joules: Joules = None,
    weights: Weights = None,
    save_weights: SaveWeights = None,
    budget_ms: given.Budget = BUDGET_MS,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities.

    With --joules also EER_AV, which compares all folders. --metrics is about results of
    real runs in CARLA.
    """
    with listening() as listener:
        found = workflow.score(
            *results,
            listener=listener,
            real_metrics=metrics,
            eer=EerOptions(joules_named(joules or ()), weights, save_weights),
            budget_ms=budget_ms,
        )
    show(found)
