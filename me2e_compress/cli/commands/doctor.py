"""``me2e-compress doctor``."""

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.workflows import doctor as workflow


def doctor(as_json: given.Json = False) -> None:
    """Show what this machine can do, and what to install for the rest."""
    show(workflow.doctor(), as_json)
