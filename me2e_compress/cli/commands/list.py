"""``me2e-compress list``."""

from typing import Annotated

import typer

from me2e_compress.cli.console import show
from me2e_compress.workflows.listing import KINDS
from me2e_compress.workflows.listing import list_entries as workflow

Kind = Annotated[str | None, typer.Argument(help=", ".join(KINDS))]


def list_entries(kind: Kind = None) -> None:
    """Show what can be named: ours, and what other packages add by entry point."""
    show(workflow(kind))
