"""``me2e-compress ranges``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli.console import show
from me2e_compress.workflows import ranges as workflow

First = Annotated[
    Path, typer.Argument(help="saved RANGES.json, or another tool's cache")
]
Second = Annotated[
    Path | None, typer.Argument(help="ranges or a cache to hold them against")
]


def ranges(first: First, second: Second = None) -> None:
    """Say which saved ranges deserve a look, and what to record instead.

    Ranges are held against the root mean square of their own tensor and against a
    second file: another recording's ranges, a TensorRT or an onnxruntime cache.
    """
    show(workflow.ranges(first, second))
