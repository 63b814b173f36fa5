"""Calibration against plain inference: CPU time and peak memory, a process each.

    python benchmarks/bench_calibration.py MODEL.onnx FRAMES/ --map vad [--frames 8]

The model is imported and folded first (the graph that quantize-int8 calibrates), then
run over the same frames, each time in a fresh process: plain, and with the gauges of
scheme "full", at the same optimization level.
"""

import argparse
import json
import resource
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.plan import make_plan, tensors_of
from me2e_compress.calibration.scheme import QuantScheme
from me2e_compress.modules import ModuleMap
from me2e_compress.passes import Context
from me2e_compress.passes.fold_constants import FoldConstants
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session, replay

RUNS = ("plain", "gauges")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--map", default="vad")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--run", choices=RUNS)
    chosen = parser.parse_args()
    if chosen.run:
        print(json.dumps(measure(chosen)))
        return
    with tempfile.TemporaryDirectory() as folder:
        folded = Path(folder) / "folded.onnx"
        prepare(chosen.model, folded, chosen.map)
        options = ["--map", chosen.map, "--frames", str(chosen.frames)]
        options += ["--threads", str(chosen.threads)]
        rows = {run: child(folded, chosen.folder, run, options) for run in RUNS}
    plain, gauges = rows["plain"], rows["gauges"]
    for name, row in rows.items():
        print(
            f"{name:8} {row['cpu_s']:7.1f} s CPU {row['wall_s']:7.1f} s wall"
            f" {row['peak_mb']:7.0f} MB peak, {row['tensors']:.0f} tensors"
        )
    print(
        f"ratio    {gauges['cpu_s'] / plain['cpu_s']:7.2f}"
        f" {gauges['wall_s'] / plain['wall_s']:14.2f}"
        f" {gauges['peak_mb'] / plain['peak_mb']:15.2f}"
    )


def prepare(source: Path, folded: Path, preset: str) -> None:
    """Write the graph that is calibrated."""
    context = Context(ModuleMap.load(preset))
    model = graph.load(source)
    graph.infer_shapes(model)
    for each in (ImportNormalize(), FoldConstants()):
        model = each.run(model, context).model
    graph.save(model, folded)


def child(model: Path, folder: Path, run: str, options: list[str]) -> dict[str, float]:
    """Measure in a process of its own."""
    command = [sys.executable, __file__, str(model), str(folder), *options]
    done = subprocess.run([*command, "--run", run], check=True, stdout=subprocess.PIPE)
    found: dict[str, float] = json.loads(done.stdout)
    return found


class Part:
    """The first frames of a recording."""

    def __init__(self, whole: CalibrationSet, count: int) -> None:
        self._frames = [whole[index] for index in range(min(count, len(whole)))]
        self.fingerprint = whole.fingerprint

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Frame]:
        return iter(self._frames)


def measure(chosen: argparse.Namespace) -> dict[str, float]:
    """Run over the frames and weigh this process."""
    model = graph.load(chosen.model)
    graph.infer_shapes(model)
    scheme = QuantScheme.named("full", ModuleMap.load(chosen.map))
    tensors = tensors_of(make_plan(model, scheme), model)
    frames = Part(CalibrationSet(chosen.folder), chosen.frames)
    cpu, wall = time.process_time(), time.perf_counter()
    if chosen.run == "gauges":
        Calibrator(threads=chosen.threads).run(model, tensors, frames)
    else:
        for _ in replay(Session(model, threads=chosen.threads), frames):
            pass
    return {
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.perf_counter() - wall,
        "peak_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024,
        "tensors": len(tensors),
    }


if __name__ == "__main__":
    main()
