"""``me2e-compress split``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.workflows import split as workflow


def split(
    model: given.Model,
    stack: given.Stack,
    output: Annotated[
        Path, typer.Option("-o", "--output", help="the folder of the files")
    ],
    force: given.Force = False,
) -> None:
    """Cut a graph that was joined, and made smaller, into its files again."""
    show(workflow.split(model, stack, output, force=force))
