"""``me2e-compress plan``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.cli.verbosity import is_verbose
from me2e_compress.workflows import plan as workflow

Model = Annotated[
    str, typer.Argument(help="the ONNX file, or highway; float or with a plan")
]
Against = Annotated[
    Path | None, typer.Option(help="a plan or model: compare; float: no overrides")
]
Output = Annotated[Path | None, typer.Option("-o", "--output", help="the plan as JSON")]


def plan(
    model: Model,
    scheme: given.Scheme = None,
    rules: given.Rules = None,
    target: given.Target = None,
    overrides: given.Overrides = None,
    module_map: given.ModuleMap = None,
    against: Against = None,
    output: Output = None,
    force: given.Force = False,
) -> None:
    """Show which nodes become int8, which stay float, by which rule, and why.

    With -v a row a node that could be int8.
    """
    options = workflow.PlanOptions(scheme, rules, target, overrides, module_map, force)
    found = workflow.plan(model, output, against, options)
    show(found, (*found.tables(), *found.nodes()) if is_verbose() else None)
