"""``me2e-compress inspect``."""

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.workflows import inspect as workflow


def inspect(
    model: given.Model,
    module_map: given.ModuleMap = None,
    as_json: given.Json = False,
) -> None:
    """Show what a graph holds: interface, and nodes, parameters, MACs by module."""
    show(workflow.inspect(model, module_map), as_json)
