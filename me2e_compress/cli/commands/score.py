"""``me2e-compress score``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.workflows import score as workflow


def score(
    results: Annotated[list[Path], typer.Argument(help="folders of results")],
    as_json: given.Json = False,
) -> None:
    """Print driving score, success rate, efficiency, comfort and abilities."""
    with listening() as listener:
        found = workflow.score(*results, listener=listener)
    show(found, as_json)
