"""``me2e-compress demo``."""

from pathlib import Path
from typing import Annotated, Literal

import typer

from me2e_compress.cli.console import console
from me2e_compress.cli.extras import need_closed_loop
from me2e_compress.cli.output import check_folder
from me2e_compress.zoo.shipped import SHIPPED


def demo(
    out: Annotated[Path, typer.Option(help="the folder to write")] = Path("out"),
    stack: Annotated[
        Literal["highway", "vad-tiny"],
        typer.Option(help="the trained driver, or a stack of published size"),
    ] = "highway",
    scheme: Annotated[
        str, typer.Option(help="feature-ext, prediction or full")
    ] = "feature-ext",
    routes: Annotated[str, typer.Option(help="that highway drives: N or ID,ID")] = "5",
    workers: Annotated[int, typer.Option(min=1, help="routes at a time")] = 2,
    rounds: Annotated[int, typer.Option(min=1, help="latency rounds of vad-tiny")] = 4,
    threads: Annotated[
        int, typer.Option(min=0, help="of onnxruntime, for vad-tiny")
    ] = 2,
) -> None:
    """Run the main job on what ships: compress, verify, compare, drive, report.

    The trained driver is compressed and drives before and after; vad-tiny, at its
    published size and with random weights, is compressed, compared and timed.
    """
    check_folder(out, ())
    out.mkdir(parents=True, exist_ok=True)
    if stack in SHIPPED:
        need_closed_loop("what the demo drives with")
        from me2e_compress.cli.demo_driver import demo_driver

        demo_driver(stack, out, scheme, routes, workers)
    else:
        from me2e_compress.cli.demo_stack import demo_stack

        demo_stack(stack, out, scheme, rounds, threads)
    console.save_svg(str(out / "demo.svg"), title="me2e-compress demo")
