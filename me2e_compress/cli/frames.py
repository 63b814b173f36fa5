"""``me2e-compress frames``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.cli.console import console, progress
from me2e_compress.zoo import frames as renderer


def frames(
    stack: Annotated[str, typer.Argument(help="vad-tiny")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the folder")],
    count: Annotated[int, typer.Option("-n", "--count", help="how many")] = 256,
    scene_length: Annotated[int, typer.Option(help="frames a scene")] = 8,
    seed: Annotated[int, typer.Option(help="of the scenes")] = 0,
) -> None:
    """Write calibration frames: synthetic six-camera scenes, coherent in time."""
    with progress("frames") as advance:
        renderer.write_frames(
            stack,
            output,
            count,
            seed,
            scene_length,
            lambda done: advance(done, count, stack),
        )
    console.print(f"{output}: {count} frames of {stack}, seed {seed}")
