"""``me2e-compress doctor``."""

from me2e_compress.cli.console import show
from me2e_compress.workflows import doctor as workflow


def doctor() -> None:
    """Show what this machine can do, and what to install for the rest."""
    show(workflow.doctor())
