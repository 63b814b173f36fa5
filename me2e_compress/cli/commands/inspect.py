"""``me2e-compress inspect``."""

from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.workflows import inspect as workflow
from me2e_compress.workflows.checks import sizes


def inspect(
    model: given.Model,
    module_map: given.ModuleMap = None,
    set_dim: given.SetDim = None,
    modelled_energy: Annotated[
        str | None,
        typer.Option(help="joules by published figures of 7nm or 45nm"),
    ] = None,
    as_json: given.Json = False,
) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module."""
    dims = sizes(set_dim or ())
    show(workflow.inspect(model, module_map, dims, modelled_energy), as_json)
