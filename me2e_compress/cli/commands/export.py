"""``me2e-compress export``."""

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import typer

from me2e_compress.cli.console import console, file_bytes, megabytes
from me2e_compress.cli.output import check_output
from me2e_compress.errors import GraphError
from me2e_compress.zoo import export as exporter
from me2e_compress.zoo import shipped

OPSET = 17
"""Of the shipped models, and of the others unless asked otherwise."""


def export(
    stack: Annotated[str, typer.Argument(help="vad-tiny or highway")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the ONNX file")],
    opset: Annotated[int, typer.Option(help="ONNX opset of the file")] = OPSET,
    heads: Annotated[
        Literal["nuscenes", "bench2drive"] | None,
        typer.Option(help="classes and ego modes of vad-tiny; default nuscenes"),
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="of the initial weights; default 0")
    ] = None,
) -> None:
    """Write a reference stack as ONNX: VAD-tiny drawn from a seed, or our driver."""
    if output.parent.is_dir():  # else it is made
        check_output([output], ())
    if stack in shipped.SHIPPED:
        _refuse(stack, {"--seed": seed, "--heads": heads}, opset)
        shipped.copy(stack, output)
    else:
        with console.status(f"exporting {stack}"):
            exporter.export(
                stack, output, opset=opset, seed=seed or 0, heads=heads or "nuscenes"
            )
    console.print(
        f"{output}: {stack}, opset {opset}, {megabytes(file_bytes(output))} MB"
    )


def _refuse(stack: str, options: Mapping[str, object], opset: int) -> None:
    """A trained model is one file: nothing about it is left to choose."""
    given = [option for option, value in options.items() if value is not None]
    if opset != OPSET:
        given.append(f"--opset {opset}")
    if given:
        raise GraphError(
            f"{stack} is a trained model of opset {OPSET}: {given[0]} cannot be chosen"
        )
