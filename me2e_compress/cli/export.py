"""``me2e-compress export``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from me2e_compress.cli.console import console, file_bytes, megabytes
from me2e_compress.zoo import export as exporter


def export(
    stack: Annotated[str, typer.Argument(help="vad-tiny")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the ONNX file")],
    opset: Annotated[int, typer.Option(help="ONNX opset of the file")] = 17,
    heads: Annotated[
        Literal["nuscenes", "bench2drive"], typer.Option(help="classes and ego modes")
    ] = "nuscenes",
    seed: Annotated[int, typer.Option(help="of the initial weights")] = 0,
) -> None:
    """Write a reference stack as ONNX, at its published dimensions."""
    with console.status(f"exporting {stack}"):
        exporter.export(stack, output, opset=opset, seed=seed, heads=heads)
    console.print(
        f"{output}: {stack}, opset {opset}, {megabytes(file_bytes(output))} MB"
    )
