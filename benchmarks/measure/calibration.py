"""Calibration against plain inference and against other tools, each in its process.

    python -m benchmarks.measure.calibration OUT [--subjects resnet50,bev-head,vad-tiny]
        [--peer-python PYTHON] [--frames N]
    python -m benchmarks.measure.calibration OUT --subjects vad-tiny --frames 256
        --only max-min --limit-gb 6            a long calibration within 6 GB

For each model, after the exact passes, over the same frames on the same threads: plain
inference and our calibration, with onnxruntime's optimizations and without, and with
histograms; onnxruntime's MinMax and Entropy; ModelOpt (which places QDQ in the same
call), where PYTHON has it. CPU seconds and peak memory count loading the model,
not importing packages. A process that takes more than --limit-gb, or leaves the
machine less than 2 GB, is stopped, and the row says so.
Where both run the nodes as they stand and the model has no state, the ranges are held
against onnxruntime's, bit for bit.
"""

import argparse
import dataclasses
import json
import subprocess
import sys
import time
from pathlib import Path

import psutil

from benchmarks.subjects.subject import Subject, at
from benchmarks.tools.peer import peak_mb
from benchmarks.tools.processes import has_modelopt
from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.quantization.decision import QuantScheme
from me2e_compress.quantization.plan import make_plan, tensors_of
from me2e_compress.runtime.session import Session, replay

OURS = {
    "plain": ("", True),
    "max-min": ("max-min", True),
    "mse": ("mse", True),
    "plain, not optimized": ("", False),
    "max-min, not optimized": ("max-min", False),
}
FRAMES = {"resnet50": 32}
PEERS = {
    "onnxruntime MinMax": "onnxruntime-minmax",
    "onnxruntime Entropy": "onnxruntime-entropy",
    "ModelOpt max": "modelopt",
}
LEFT_GB = 2.0
"""Memory of the machine that no process here may use up."""
LEVEL = {
    "max-min": "plain",
    "mse": "plain",
    "max-min, not optimized": "plain, not optimized",
}
"""What each of our rows is divided by; peers are divided by ``plain``."""


@dataclasses.dataclass(frozen=True)
class Row:
    """What one process took, or had taken so far; no seconds where it was stopped."""

    cpu_s: float | None
    wall_s: float | None
    peak_mb: float
    tensors: int | None = None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subjects", default="resnet50,bev-head,vad-tiny")
    parser.add_argument("--frames", type=int, help="8, and 32 of resnet50")
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--limit-gb", type=float, default=14)
    parser.add_argument("--peer-python", type=Path, default=Path(sys.executable))
    parser.add_argument("--only", default="", help="rows to measure, parted by ;")
    parser.add_argument("--run", help="what this process is to measure")
    chosen = parser.parse_args()
    if chosen.run:
        print(json.dumps(measure(chosen)))
        return
    from benchmarks.subjects import (
        subjects,
    )  # torch: not in the processes that are measured

    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in chosen.subjects.split(","):
        count = chosen.frames or FRAMES.get(name, 8)
        subject = subjects.make(name, chosen.out, count)
        print(f"\n{name}, {count} frames, {chosen.threads} threads\n", flush=True)
        show(subject, rows_of(subject, chosen, count))


def rows_of(
    subject: Subject, chosen: argparse.Namespace, count: int
) -> dict[str, Row | str]:
    """Measure everything, one process after the other."""
    rows: dict[str, Row | str] = {}
    common = ["--frames", str(count), "--threads", str(chosen.threads)]
    wanted = asked(chosen.only)
    for name in filter(wanted.__contains__, OURS):
        command = [sys.executable, "-m", "benchmarks.measure.calibration"]
        command += [str(subject.folder), "--run", name, *common]
        rows[name] = watch(command, chosen.limit_gb)
    for name, tool in PEERS.items():
        if name not in wanted:
            continue
        python = chosen.peer_python if tool == "modelopt" else Path(sys.executable)
        if tool == "modelopt" and not has_modelopt(python):
            rows[name] = f"not installed for {python}"
            continue
        output = subject.folder / f"{tool}.out"
        command = [str(python), "-W", "ignore", "benchmarks/tools/peer.py", tool]
        command += [str(subject.model), str(subject.frames), str(output), *common]
        rows[name] = watch(command, chosen.limit_gb)
    return rows


def asked(only: str) -> tuple[str, ...]:
    """Name the rows to measure, in order."""
    every = (*OURS, *PEERS)
    wanted = [name.strip() for name in only.split(";") if name.strip()] or every
    for name in wanted:
        if name not in every:
            raise SystemExit(f"no row {name!r}; there are {'; '.join(every)}")
    return tuple(name for name in every if name in wanted)


def watch(command: list[str], limit_gb: float) -> Row | str:
    """Run a process; stop it where it takes more memory than it may, or there is."""
    process = subprocess.Popen(
        command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    peak = 0.0
    seen = psutil.Process(process.pid)
    while process.poll() is None:
        try:
            peak = max(peak, seen.memory_info().rss / 2**20)
        except psutil.NoSuchProcess:
            break
        left = psutil.virtual_memory().available / 2**30
        if peak > limit_gb * 1024 or left < LEFT_GB:
            process.kill()
            process.communicate()
            return Row(None, None, peak)
        time.sleep(0.05)
    out, err = process.communicate()
    if process.returncode:
        return f"failed: {(err.strip().splitlines() or ['no message'])[-1][:120]}"
    return Row(**json.loads(out.strip().splitlines()[-1]))


def measure(chosen: argparse.Namespace) -> dict[str, float | int | None]:
    """Run over the frames and weigh this process."""
    method, optimize = OURS[chosen.run]
    subject = at(chosen.out)
    recording = CalibrationSet(subject.frames)
    frames = recording.part(range(min(chosen.frames, len(recording))))
    cpu, wall = time.process_time(), time.perf_counter()
    tensors: tuple[str, ...] = ()
    model = graph.load(subject.model)
    if method:
        graph.infer_shapes(model)
        modules = ModuleMap.load(str(subject.map))
        tensors = tensors_of(
            make_plan(model, QuantScheme.named("full", modules)), model
        )
        found = Calibrator(method, chosen.threads, optimize).run(model, tensors, frames)
        found.save(subject.folder / f"{chosen.run}.json")
    else:
        session = Session(model, threads=chosen.threads, optimize=optimize)
        for _ in replay(session, frames):
            pass
    return {
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.perf_counter() - wall,
        "peak_mb": peak_mb(),
        "tensors": len(tensors) or None,
    }


def show(subject: Subject, rows: dict[str, Row | str]) -> None:
    print("| run | tensors | CPU s | x plain | peak MB | x plain | + MB |")
    print("|---|---|---|---|---|---|---|")
    for name, row in rows.items():
        if isinstance(row, str):
            print(f"| {name} | | {row} | | | | |")
            continue
        plain = rows.get(LEVEL.get(name, "plain"))
        cpu_s = plain.cpu_s if isinstance(plain, Row) else None
        peak = plain.peak_mb if isinstance(plain, Row) else None
        print(
            f"| {name} | {row.tensors or ''} | {shown(row.cpu_s, '.1f')}"
            f" | {ratio(row.cpu_s, cpu_s)} | {row.peak_mb:.0f}"
            f" | {ratio(row.peak_mb, peak)} | {more(row.peak_mb, peak)} |"
        )
    if {"max-min, not optimized", "onnxruntime MinMax"} <= rows.keys():
        print(f"\n{agreement(subject)}", flush=True)


def ratio(above: float | None, below: float | None) -> str:
    return "-" if above is None or below is None else f"{above / below:.2f}"


def more(above: float | None, below: float | None) -> str:
    return "-" if above is None or below is None else f"{above - below:+.0f}"


def shown(value: float | None, form: str) -> str:
    return "stopped" if value is None else format(value, form)


def agreement(subject: Subject) -> str:
    """Say how many ranges are onnxruntime's, bit for bit."""
    ours = subject.folder / "max-min, not optimized.json"
    theirs = subject.folder / "onnxruntime-minmax.out"
    if Session(subject.model, threads=1, optimize=False).recurrent:
        return "ranges: not comparable, the other tools feed no state forward"
    if not ours.is_file() or not theirs.is_file():
        return "ranges: not compared, one of the two did not finish"
    mine = json.loads(ours.read_text())["tensors"]
    other = json.loads(theirs.read_text())
    common = [name for name in mine if name in other]
    equal = sum(mine[name] == other[name] for name in common)
    return f"ranges equal to onnxruntime's MinMax: {equal} of {len(common)} in common"


if __name__ == "__main__":
    main()
