"""Train the driver from nothing.

    python -m models.driver.train -o FOLDER [--seed N] [--overlook SHARE]
                           [--workers N] [--small]

The same command again goes on where it was interrupted.
"""

import sys
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import AGAIN, run_in_order
from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.extras import need_extra

Output = Annotated[
    Path, typer.Option("-o", "--output", help="the folder; the same again resumes")
]
Small = Annotated[
    bool, typer.Option("--small", help="every part, a minute, learns nothing")
]

Seed = Annotated[int, typer.Option(help="of the first weights, not of the routes")]
Overlook = Annotated[
    float | None,
    typer.Option(
        min=0.0,
        max=1.0,
        help="share of agents the planner is not told of: only occupancy shows them",
    ),
]


def command(
    output: Output,
    workers: given.Workers = 4,
    small: Small = False,
    seed: Seed = 0,
    overlook: Overlook = None,
    json: given.Json = False,
) -> None:
    """Train the driver from nothing: collect, learn, drive, learn again (hours)."""
    need_extra("highway", "training")
    from models.driver.workflow import train  # takes torch seconds to import

    with listening(stages=True) as listener:
        found = train(
            output,
            workers,
            listener,
            small=small,
            seed=seed,
            overlook=overlook,
        )
    show(found)


def main() -> int:
    """Run the command, with one line for an error, as ``me2e-compress`` does."""
    app = typer.Typer(add_completion=False, pretty_exceptions_enable=False)
    app.command()(command)
    return run_in_order(partial(app, prog_name="python -m models.driver.train"), AGAIN)


if __name__ == "__main__":
    sys.exit(main())
