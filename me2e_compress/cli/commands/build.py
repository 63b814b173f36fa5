"""``me2e-compress build``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.targets.tensorrt.tensorrt_engine import EngineSettings, Precision
from me2e_compress.workflows import build as workflow

Output = Annotated[Path, typer.Option("-o", "--output", help="the engine")]
Types = Annotated[
    Precision, typer.Option("--precision", help="graph: its own types; fp16: float too")
]
Plugins = Annotated[
    list[Path] | None, typer.Option(help="a library of TensorRT plugins; once for each")
]


def build(
    model: given.Model,
    output: Output,
    precision: Types = "graph",
    plugins: Plugins = None,
    force: given.Force = False,
) -> None:
    """Build a TensorRT engine of a graph, for the GPU of this machine."""
    settings = EngineSettings(precision, tuple(plugins or ()))
    with listening() as listener:
        options = workflow.BuildOptions(settings, force)
        found = workflow.build(model, output, options, listener)
    show(found)
