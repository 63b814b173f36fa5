"""The demo with a driver: compressed, then both drive the same routes."""

from pathlib import Path

from me2e_compress import graph, recipe
from me2e_compress.cli import job
from me2e_compress.cli.commands.compare import judge
from me2e_compress.cli.commands.frames import record
from me2e_compress.cli.commands.inspect import weigh
from me2e_compress.cli.commands.study import listener, shown
from me2e_compress.cli.console import console, progress
from me2e_compress.cli.int8 import Int8Options
from me2e_compress.cli.tables import (
    fidelity_table,
    modules_table,
    notes,
    plan_line,
    steps_table,
    verification_table,
)
from me2e_compress.evaluators.highway.engine import LocalEngine
from me2e_compress.modules import Item, map_of
from me2e_compress.passes import Pass
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.simulator.routes import load_routes, pick_routes
from me2e_compress.study import Condition, Scheme, Study, Timing, run_study
from me2e_compress.study.tables import differences, scoreboards
from me2e_compress.study.write import write
from me2e_compress.zoo import shipped

CALIBRATION_FRAMES, CALIBRATION_SEED = 64, 0
HELD_OUT_FRAMES, HELD_OUT_SEED = 24, 1
LATENCY_SAMPLES = 100
FLOAT, TARGET = "float", "onnxruntime"


def demo_driver(name: str, out: Path, scheme: str, routes: str, workers: int) -> None:
    """Copy the driver that ships, compress it, hold both against each other.

    Raises:
        Me2eError: What the steps raise, one line each.
    """
    everything = load_routes()
    picked = pick_routes(everything, routes)
    passes = _for_here(recipe.load(scheme))
    source = shipped.copy(name, out / f"{name}.onnx")
    small = out / f"{name}.{scheme}.onnx"
    frames = _frames(source, out / "frames", CALIBRATION_FRAMES, CALIBRATION_SEED)
    held_out = _frames(source, out / "frames-held-out", HELD_OUT_FRAMES, HELD_OUT_SEED)
    _compress(source, small, passes, frames)
    fidelity = judge(source, small, held_out)
    console.print(fidelity_table(fidelity))
    console.print(plan_line(fidelity))
    study = Study(
        f"{name} before and after {scheme}",
        (Scheme(FLOAT, str(source)), Scheme(scheme, str(small))),
        (Condition("ideal", "none"),),
        FLOAT,
        picked,
        len(everything),
        held_out=held_out,
        timing=Timing(LATENCY_SAMPLES),
    )
    with listener() as told:
        found = run_study(study, out, LocalEngine(workers), told)
    words = ("me2e-compress", "demo", "--out", str(out), "--routes", routes)
    written = write(found, out, (*words, "--scheme", scheme))
    for each in (*scoreboards(found), differences(found)):
        console.print(shown(each))
    console.print(f"{small} and {written.report} are yours.")
    console.print(
        f"Its int8 is for {TARGET}, which drives here. For TensorRT: me2e-compress"
        f" compress {name} -r {scheme} --frames {frames} -o {name}.trt.onnx"
    )


def _for_here(passes: tuple[Pass, ...]) -> tuple[Pass, ...]:
    """Aim int8 at what drives: placed for TensorRT it is slower here than float."""
    if any(isinstance(each, QuantizeInt8) for each in passes):
        return Int8Options(target=TARGET).apply(passes)
    return passes


def _frames(model: Path, folder: Path, count: int, seed: int) -> Path:
    with progress("frames") as advance:
        return record(
            str(model),
            folder,
            count,
            seed,
            on_frame=lambda done: advance(done, count, folder.name),
        )


def _compress(
    source: Path, small: Path, passes: tuple[Pass, ...], frames: Path
) -> None:
    """Compress, write the file and its report, and say what each pass did."""
    report = job.run(source, passes, frames, None, 0, 2, small.parent)
    job.write(report, source, small)
    console.print(steps_table(report.steps))
    console.print(notes(report.steps))
    console.print(verification_table(report.verifications))
    console.print(modules_table(_weigh(source), _weigh(small)))


def _weigh(path: Path) -> tuple[Item, ...]:
    model = graph.load(path)
    return weigh(model, map_of(model, None))
