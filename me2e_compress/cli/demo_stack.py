"""The demo with a stack of published size: nothing drives."""

from pathlib import Path

from rich.table import Table

from me2e_compress import graph, recipe
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.cli import job
from me2e_compress.cli.commands.compare import judge
from me2e_compress.cli.commands.export import export
from me2e_compress.cli.commands.frames import frames
from me2e_compress.cli.commands.inspect import weigh
from me2e_compress.cli.console import (
    console,
    file_bytes,
    megabytes,
    progress,
    table,
)
from me2e_compress.cli.tables import (
    fidelity_table,
    modules_table,
    notes,
    plan_line,
    steps_table,
    verification_table,
)
from me2e_compress.modules import Item, map_of
from me2e_compress.runtime.interleaved import Lap, race
from me2e_compress.runtime.session import Session

CALIBRATION_FRAMES, HELD_OUT_FRAMES = 8, 4
SCENE_LENGTH = 4
CALIBRATION_SEED, HELD_OUT_SEED = 0, 1


def demo_stack(stack: str, out: Path, scheme: str, rounds: int, threads: int) -> None:
    """Export a stack of the zoo, make it small, show what that did to it.

    Raises:
        Me2eError: What the steps raise, one line each.
    """
    source = out / f"{stack}.onnx"
    export(stack, source)
    calibration, held_out = out / "frames", out / "frames-held-out"
    frames(stack, calibration, CALIBRATION_FRAMES, SCENE_LENGTH, CALIBRATION_SEED)
    frames(stack, held_out, HELD_OUT_FRAMES, SCENE_LENGTH, HELD_OUT_SEED)
    small = out / f"{stack}.{scheme}.onnx"
    report = job.run(source, recipe.load(scheme), calibration, None, 0, 2, out)
    record = job.write(report, source, small)
    console.print(steps_table(report.steps))
    console.print(notes(report.steps))
    console.print(verification_table(report.verifications))
    console.print(modules_table(_weigh(source), _weigh(small)))
    found = judge(source, small, held_out)
    console.print(fidelity_table(found))
    console.print(plan_line(found))
    exact = out / f"{stack}.exact.onnx"
    job.write(
        job.run(source, recipe.load("exact"), None, None, 0, 0, out), source, exact
    )
    console.print(_files((source, exact, small), held_out, rounds, threads))
    console.print(f"{small} and {record} are yours.")


def _weigh(path: Path) -> tuple[Item, ...]:
    model = graph.load(path)
    return weigh(model, map_of(model, None))


def _files(paths: tuple[Path, ...], frames: Path, rounds: int, threads: int) -> Table:
    """Show size and latency of every file, measured in turn on one frame."""
    recording = CalibrationSet(frames)
    sessions = {
        path.name: Session(path, threads=threads, release=True) for path in paths
    }
    with progress("latency") as advance:
        laps = race(sessions, [recording[0]], rounds, advance)
    shown = table(
        f"Files, and latency on this CPU ({threads} threads, {rounds} rounds in turn)",
        "file",
        "MB",
        "median s",
        "best s",
        "CPU s",
        "ratio to the first",
    )
    first = laps[paths[0].name]
    for path in paths:
        lap = laps[path.name]
        shown.add_row(
            path.name,
            megabytes(file_bytes(path)),
            f"{lap.median_wall_s:.3f}",
            f"{lap.best_wall_s:.3f}",
            f"{min(lap.cpu_s):.3f}",
            f"{_ratio(lap, first):.3f}",
        )
    shown.caption = (
        "int8 here is placed for TensorRT; onnxruntime's CPU runs such graphs slower"
    )
    shown.caption_justify = "left"
    return shown


def _ratio(lap: Lap, first: Lap) -> float:
    return lap.median_wall_s / first.median_wall_s
