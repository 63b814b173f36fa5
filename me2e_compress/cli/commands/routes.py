"""``me2e-compress routes``."""

from pathlib import Path
from typing import Annotated

import typer
from rich.table import Table

from me2e_compress.cli.console import console, errors, print_json, progress
from me2e_compress.cli.output import check_output
from me2e_compress.errors import EvaluationError
from me2e_compress.evaluators.highway.admission import Admission, examine
from me2e_compress.evaluators.highway.generate import VARIANTS, ScenarioRoutes, generate
from me2e_compress.simulator.routes import (
    load_routes,
    pick_routes,
    save_routes,
)
from me2e_compress.simulator.scenarios.catalogue import SCENARIO_ABILITIES


def routes(
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="the manifest to write")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="decides every route")] = 0,
    variants: Annotated[int, typer.Option(min=1, help="of each type")] = VARIANTS,
    scenarios: Annotated[str, typer.Option(help="all, or NAME,NAME")] = "all",
    workers: Annotated[int, typer.Option(min=1, help="types at a time")] = 1,
    check: Annotated[
        Path | None,
        typer.Option(help="examine this manifest instead of making one"),
    ] = None,
    pick: Annotated[str, typer.Option(help="with --check: all, N or ID,ID")] = "all",
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Make a fresh set of routes and admit it, or put a set through the gate again."""
    if check is not None:
        _check(check, pick, as_json)
        return
    if output is None:
        raise typer.BadParameter("a new set needs -o ROUTES.json", param_hint="-o")
    check_output([output], ())
    names = _names(scenarios)
    harvests = list[ScenarioRoutes]()
    with progress("admitting") as advance:
        for harvest in generate(seed, names, variants, workers):
            harvests.append(harvest)
            advance(len(harvests), len(names), harvest.scenario)
    save_routes([route for one in harvests for route in one.routes], output)
    _report(harvests, output, as_json)


def _names(scenarios: str) -> tuple[str, ...]:
    if scenarios == "all":
        return tuple(SCENARIO_ABILITIES)
    names = tuple(name.strip() for name in scenarios.split(","))
    for name in names:
        if name not in SCENARIO_ABILITIES:
            there = ", ".join(sorted(SCENARIO_ABILITIES))
            raise EvaluationError(f"no scenario {name!r}; there are {there}")
    return names


def _report(harvests: list[ScenarioRoutes], output: Path, as_json: bool) -> None:
    admitted = sum(len(one.routes) for one in harvests)
    tried = sum(one.tried for one in harvests)
    if as_json:
        rows = [
            {
                "scenario": one.scenario,
                "admitted": len(one.routes),
                "tried": one.tried,
                "refusals": one.refusals,
            }
            for one in harvests
        ]
        print_json({"admitted": admitted, "tried": tried, "scenarios": rows})
        return
    shown = Table("scenario", "admitted", "tried", "refused because")
    for one in harvests:
        why = "; ".join(dict.fromkeys(one.refusals))
        shown.add_row(one.scenario, str(len(one.routes)), str(one.tried), why)
    console.print(shown)
    share = admitted / tried
    console.print(f"{admitted} routes of {tried} tried ({share:.0%}) -> {output}")


def _check(manifest: Path, pick: str, as_json: bool) -> None:
    verdicts = list[Admission]()
    picked = pick_routes(load_routes(manifest), pick)
    with progress("examining") as advance:
        for route in picked:
            verdicts.append(examine(route))
            advance(len(verdicts), len(picked), route.id)
    refused = [one for one in verdicts if not one.admitted]
    if as_json:
        why = {one.route.id: one.refusal for one in refused}
        print_json({"examined": len(verdicts), "refused": why})
    else:
        for one in refused:
            errors.print(f"{one.route.id}: {one.refusal}")
        admitted = len(verdicts) - len(refused)
        console.print(f"{admitted} of {len(verdicts)} routes admitted")
    if refused:
        raise EvaluationError(
            f"{manifest}: {len(refused)} of {len(verdicts)} routes are not admitted, "
            f"the first is {refused[0].route.id}: {refused[0].refusal}"
        )
