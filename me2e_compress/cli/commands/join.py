"""``me2e-compress join``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.workflows import join as workflow


def join(
    stack: given.Stack,
    output: Annotated[Path, typer.Option("-o", "--output", help="the joined graph")],
    force: given.Force = False,
) -> None:
    """Join the files of a model into one graph, which all commands take."""
    show(workflow.join(stack, output, force=force))
