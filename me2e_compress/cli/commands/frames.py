"""``me2e-compress frames``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.calibration.recording import LOGS
from me2e_compress.cli import arguments as given
from me2e_compress.cli.console import listening, show
from me2e_compress.runtime.providers import provider_named
from me2e_compress.workflows import frames as workflow

Length = Annotated[
    int | None,
    typer.Option(
        help=f"frames a scene; default {workflow.DRIVEN_SCENE_LENGTH}, of a log all"
    ),
]
Log = Annotated[
    str | None,
    typer.Option("--from", help="recorded driving, read by another package: LOG:ROOT"),
]


def frames(
    stack: Annotated[
        str,
        typer.Argument(help="highway, or M.onnx"),
    ],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    count: given.Count = 256,
    scene_length: Length = None,
    log: Log = None,
    adapter: given.Adapter = None,
    seed: given.Seed = 0,
    provider: given.Provider = "cpu",
    force: given.Force = False,
) -> None:
    """Write calibration frames, coherent in time, seen by six cameras.

    For a driver that ships, or any ONNX file that keeps the policy contract
    (--adapter), the expert drives fresh routes. With --from, recorded driving is laid
    out as the file takes it (docs/writing-logs.md).
    """
    options = workflow.FramesOptions(
        count,
        seed,
        scene_length,
        force,
        provider_named(provider),
        None if log is None else LOGS.parse(log),
        adapter,
    )
    with listening() as listener:
        workflow.record_frames(stack, output, options, listener)
    show(workflow.FramesResult(stack, output, options))
