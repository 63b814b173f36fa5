"""``me2e-compress inspect``."""

from pathlib import Path
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
    trace: Annotated[
        Path | None, typer.Option(help="latencies by module, of profile --by-module")
    ] = None,
    adapter: given.Adapter = None,
) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module.

    With --trace also each module's share of the time of a frame.
    """
    dims = sizes(set_dim or ())
    show(workflow.inspect(model, module_map, dims, trace, adapter))
