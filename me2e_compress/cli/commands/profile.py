"""``me2e-compress profile``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.cli.console import console, number, print_json, progress, table
from me2e_compress.cli.models import model_path
from me2e_compress.cli.output import check_output
from me2e_compress.runtime.latency_trace import PERCENTILES, LatencyTrace
from me2e_compress.runtime.profile import WARM_UP
from me2e_compress.runtime.profile import profile as measure


def profile(
    model: Annotated[str, typer.Argument(help="the graph, or highway")],
    frames: Annotated[Path, typer.Argument(help="the recorded FRAMES")],
    output: Annotated[Path, typer.Option("-o", "--output", help="the trace")],
    samples: Annotated[int | None, typer.Option(help="how many latencies")] = None,
    warm_up: Annotated[int, typer.Option(help="inferences before")] = WARM_UP,
    threads: Annotated[
        int, typer.Option(min=0, help="of onnxruntime; 0 takes all")
    ] = 1,
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Measure a model alone and warm, and write its latencies as a trace."""
    source = model_path(model)
    check_output([output], (source, frames))
    with progress("profile") as advance:
        trace = measure(
            source,
            CalibrationSet(frames),
            samples=samples,
            warm_up=warm_up,
            threads=threads,
            on_sample=lambda done, total: advance(done, total, "inferences"),
        )
    trace.save(output)
    if as_json:
        print_json(trace.to_json())
    else:
        _show(trace, output)


def _show(trace: LatencyTrace, output: Path) -> None:
    title = f"{output}: {len(trace.samples_us)} inferences on {trace.machine}"
    shown = table(title, "latency", "ms")
    for percent in PERCENTILES:
        shown.add_row(f"p{percent}", number(trace.percentile_us(percent) / 1e3, ".2f"))
    shown.add_row("max", number(trace.max_us / 1e3, ".2f"))
    console.print(shown)
