"""``me2e-compress routes``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.simulator.routes import VARIANTS
from me2e_compress.workflows import routes as workflow

Output = Annotated[
    Path | None, typer.Option("-o", "--output", help="the manifest to write")
]
Examine = Annotated[
    Path | None, typer.Option(help="examine this manifest instead of making one")
]
Scenarios = Annotated[str, typer.Option(help="scenario types: all, or NAME,NAME")]
Picked = Annotated[
    str, typer.Option("--routes", "--pick", help=f"{given.ROUTES}; with --examine")
]


def routes(
    output: Output = None,
    seed: given.Seed = 0,
    variants: Annotated[
        int, typer.Option(min=1, help="routes of each type")
    ] = VARIANTS,
    scenarios: Scenarios = "all",
    workers: given.Workers = 1,
    examine: Examine = None,
    picked: Picked = "all",
    force: given.Force = False,
) -> None:
    """Make a fresh set of admitted routes, or examine an existing set again."""
    if examine is not None:
        with listening() as listener:
            examined = workflow.examine_routes(examine, picked, listener)
        show(examined)
        examined.check()
        return
    if output is None:
        raise typer.BadParameter("a new set needs -o ROUTES.json", param_hint="-o")
    options = workflow.RoutesOptions(seed, variants, scenarios, workers, force)
    with listening() as listener:
        made = workflow.make_routes(output, options, listener)
    show(made)
