"""``me2e-compress compare``."""

from pathlib import Path
from typing import Annotated

import typer

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.cli.console import console, print_json, progress
from me2e_compress.cli.models import model_path
from me2e_compress.cli.tables import fidelity_table, plan_line
from me2e_compress.fidelity.compare import Fidelity
from me2e_compress.fidelity.compare import compare as measure
from me2e_compress.runtime.session import Session


def compare(
    reference: Annotated[str, typer.Argument(help="the graph to be true to")],
    candidate: Annotated[str, typer.Argument(help="the graph that is judged")],
    frames: Annotated[Path, typer.Argument(help="the recorded FRAMES")],
    as_json: Annotated[bool, typer.Option("--json", help="for programs")] = False,
) -> None:
    """Run two graphs over frames: SQNR of every output, plan displacement in metres."""
    found = judge(model_path(reference), model_path(candidate), frames)
    if as_json:
        print_json(found)
        return
    console.print(fidelity_table(found))
    console.print(plan_line(found))


def judge(reference: Path, candidate: Path, frames: Path) -> Fidelity:
    """Check the frames against both graphs, then compare them frame by frame."""
    recording = CalibrationSet(frames)
    for path in (reference, candidate):
        recording.check(graph.load(path))
    total = len(recording)
    with progress("frames") as advance:
        read = (advance(f.index, total, "") or f for f in recording)
        left, right = (Session(path, release=True) for path in (reference, candidate))
        return measure(left, right, read)
