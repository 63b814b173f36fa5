"""``me2e-compress export``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.workflows import export as workflow

Heads = Annotated[
    str | None,
    typer.Option(
        help="vad-tiny: nuscenes or bench2drive; tcp: bench2drive or beta; default the"
        " first"
    ),
]
Opset = Annotated[
    int, typer.Option(help="opset of the file: 13 to 18; 18 by torch's dynamo exporter")
]
Seed = Annotated[
    int | None,
    typer.Option(min=0, help="seed of everything random: the weights; default 0"),
]

DialectName = Annotated[
    str | None,
    typer.Option(
        help="deformable attention (not of tcp) as one node of this plugin library, or"
        " of our own, me2e"
    ),
]
Weights = Annotated[
    Path | None,
    typer.Option(
        help="file of weights: a checkpoint of the original (.pth, .ckpt, .safetensors)"
    ),
]
Ema = Annotated[
    bool, typer.Option("--ema", help="the moving averages (ema_...) of --weights")
]


def export(
    stack: Annotated[
        str,
        typer.Argument(
            help="vad-tiny, uniad-tiny, uniad-trt, tcp, highway or highway-2"
        ),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="the ONNX file")],
    opset: Opset = workflow.OPSET,
    heads: Heads = None,
    seed: Seed = None,
    dialect: DialectName = None,
    weights: Weights = None,
    ema: Ema = False,
    force: given.Force = False,
) -> None:
    """Write a reference stack: random weights, a checkpoint's, or our driver."""
    options = workflow.ExportOptions(opset, heads, seed, force, dialect, weights, ema)
    with listening() as listener:
        listener.on_progress(f"exporting {stack}", 0, 1, "")
        found = workflow.export_stack(stack, output, options)
    show(found)
