"""``me2e-compress sensitivity``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.markup import escape

from me2e_compress.cli.console import (
    console,
    megabytes,
    number,
    print_json,
    progress,
    table,
)
from me2e_compress.cli.limits import check_number
from me2e_compress.cli.output import check_folder
from me2e_compress.cli.road import drives_of, on_routes
from me2e_compress.cli.trials import (
    Count,
    Json,
    Map,
    Model,
    Output,
    Recording,
    Rules,
    Saved,
    Scheme,
    Setting,
    Threads,
)
from me2e_compress.errors import RecipeError
from me2e_compress.sensitivity import Score, Sensitivity, advise, analyse


def sensitivity(
    model: Model,
    frames: Recording,
    output: Output,
    scheme: Scheme = "full",
    rules: Rules = "paper",
    target: Annotated[str, typer.Option(help="who runs the graph")] = "tensorrt",
    limit: Annotated[
        float,
        typer.Option(help="largest loss of the recipe: metres of the plan, see below"),
    ] = 0.1,
    drive: Annotated[
        str | None,
        typer.Option(help="drive each module's int8: all, a number, ID,ID or a file"),
    ] = None,
    drive_limit: Annotated[
        float | None,
        typer.Option(help="with --drive: most points of DS that the recipe may lose"),
    ] = None,
    adapter: Annotated[
        Path | None, typer.Option(help="with --drive: TOML, adapts the model")
    ] = None,
    workers: Annotated[
        int, typer.Option(min=1, help="with --drive: routes at a time")
    ] = 1,
    node_trials: Annotated[
        int, typer.Option(min=0, help="most trials on the nodes of a module; 0: none")
    ] = 24,
    ranges: Saved = None,
    module_map: Map = None,
    count: Count = 4,
    threads: Threads = 0,
    as_json: Json = False,
) -> None:
    """Measure what int8 costs per module and node, and write a recipe within a limit.

    The loss is how far the plan moves, metres, mean over the frames; of a model
    whose plan is not known, the noise of its worst output relative to the signal.
    With --drive every module, all together and the float model drive the routes
    too; the episodes stay in RECIPE.drives, and run again, it goes on from them.
    """
    check_number("--limit", limit, zero=True)
    check_number("--drive-limit", drive_limit, zero=True)
    if drive is None and (drive_limit is not None or adapter is not None):
        raise RecipeError("--drive-limit and --adapter say how to drive: add --drive")
    setting = Setting(
        model, frames, scheme, rules, target, ranges, module_map, count, threads
    )
    setting.check_output(output, adapter, drive)
    on_road = None
    if drive is not None:
        check_folder(drives_of(output), (frames,))
        on_road = on_routes(drive, model, drives_of(output), adapter, workers)
    trials, modules = setting.trials(on_road)
    with progress("modules") as advance:
        found = analyse(trials, modules, node_trials=node_trials, progress=advance)
    choice = advise(trials, found, limit, drive_limit)
    written = setting.write(output, choice)
    if as_json:
        print_json(found)
        return
    _show(found)
    console.print(escape(written), soft_wrap=True)
    if choice.modules:
        score = trials.score(choice)
        console.print(f"its loss: {score.loss:.4g} {score.unit}, limit {limit:g}")
        driving = trials.driving(choice)
        if driving is not None:
            console.print(f"its DS: {driving:.1f}, float {found.float_driving:.1f}")


def _show(found: Sensitivity) -> None:
    unit = found.together.unit
    columns = ["module", "nodes", f"loss {unit}", "worst dB"]
    driven = found.float_driving is not None
    shown = table("Int8 module by module", *columns, *(["DS"] if driven else []))
    if driven:
        shown.add_row("none", "", "0", "", number(found.float_driving, ".1f"))
    for each in found.findings:
        nodes = str(each.nodes)
        shown.add_row(each.module, nodes, *_cells(each.score, each.driving, driven))
    shown.add_row("together", "", *_cells(found.together, found.driving, driven))
    size = megabytes(found.together.weight_bytes)
    shown.caption = f"{found.trials} variants run; together {size} MB of weights"
    console.print(shown)
    for each in found.findings:
        for group, loss in each.blamed:
            first, *rest = group
            more = f" and {len(rest)} more" if rest else ""
            line = f"{each.module}: {first}{more}: {loss:.4g} {unit} alone"
            console.print(escape(line), soft_wrap=True)


def _cells(score: Score, driving: float | None, driven: bool) -> list[str]:
    worst = min(item.sqnr_db for item in score.fidelity.outputs)
    cells = [f"{score.loss:.4g}", f"{worst:.1f}"]
    return [*cells, number(driving, ".1f")] if driven else cells
