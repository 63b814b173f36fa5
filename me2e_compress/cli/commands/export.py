"""``me2e-compress export``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import show
from me2e_compress.shipped.drivers import SHIPPED
from me2e_compress.workflows.export import export_stack


def export(
    stack: Annotated[str, typer.Argument(help=" or ".join(SHIPPED))],
    output: Annotated[Path, typer.Option("-o", "--output", help="the ONNX file")],
    force: given.Force = False,
) -> None:
    """Write a trained driver that ships."""
    show(export_stack(stack, output, force=force))
