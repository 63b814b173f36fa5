"""``me2e-compress score``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape
from rich.table import Table

from me2e_compress.cli.console import console, errors, number, print_json, table
from me2e_compress.evaluators.highway.results import ResultsFolder
from me2e_compress.metrics import scores as metrics
from me2e_compress.metrics.measure import Estimate
from me2e_compress.metrics.scores import Scores


def score(
    results: Annotated[list[Path], typer.Argument(help="folders of results")],
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities."""
    found = {str(path): _scores(path) for path in results}
    if not as_json:
        for name, scores in found.items():
            console.print(scores_table(name, scores))
        return
    records = [{"results": name, **each.to_json()} for name, each in found.items()]
    print_json(records[0] if len(records) == 1 else records)


def scores_table(name: str, scores: Scores) -> Table:
    """Show every score with its unit, its interval and its number of routes."""
    routes = f"{scores.routes} of {scores.expected} routes"
    partial = ", PARTIAL: no comparison with a whole set" if scores.partial else ""
    shown = table(f"{name}: {routes}{partial}", "score", "mean", "95 %", "n", "unit")
    rows = {
        "driving score": scores.driving_score,
        "success rate": scores.success_rate,
        "efficiency": scores.efficiency,
        "comfort": scores.comfort,
        "abilities, mean": scores.abilities,
        **{f"  {each}": rate for each, rate in scores.each_ability.items()},
        "Bench2Drive's efficiency": scores.bench2drive_efficiency,
        "Bench2Drive's smoothness": scores.bench2drive_smoothness,
    }
    for label, estimate in rows.items():
        shown.add_row(label, *_cells(estimate))
    return shown


def _cells(estimate: Estimate) -> tuple[str, str, str, str]:
    measure = estimate.measure
    form = ".2f" if measure.unit == "%" else ".3f"
    if measure.value is None:
        return "-", "-", str(estimate.n), f"not measured: {measure.reason}"
    between = f"{number(estimate.low, form)} to {number(estimate.high, form)}"
    return number(measure.value, form), between, str(estimate.n), measure.unit


def _scores(path: Path) -> Scores:
    folder = ResultsFolder.open(path)
    episodes = tuple(folder.episodes().values())
    for file, reason in folder.corrupt.items():
        line = escape(f"{file}: {reason}: left out")
        errors.print(f"warning: {line}", soft_wrap=True)
    return metrics.score(episodes, folder.set_size)
