"""Exact passes against onnxsim and onnxslim: time, nodes, bytes, error, latency.

    python benchmarks/bench_exact_passes.py model.onnx frames/
    python benchmarks/bench_exact_passes.py --scaling

Each tool works in a process of its own, from file to file; the seconds are the CPU
time from after its imports to the written file. Latencies are interleaved: round by
round every graph runs one frame.
"""

import argparse
import contextlib
import io
import json
import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime

ROUNDS = 12
THREADS = 2
SYNTHETIC_MAP = """
[modules.stack]
role = "feature"
optional = ["stage.*"]
"""
TOOLS = ("ours", "onnxsim", "onnxslim")
Frame = dict[str, npt.NDArray[np.generic]]


def ours(source: Path, target: Path, preset: str) -> Callable[[], None]:
    from me2e_compress import graph
    from me2e_compress.graph import provenance
    from me2e_compress.modules import ModuleMap
    from me2e_compress.passes import PASSES, Context

    if preset:
        modules = ModuleMap.load(preset)
    else:
        modules = ModuleMap.parse(SYNTHETIC_MAP, "synthetic")
    names = ("import-normalize", "fold-constants", "eliminate-redundant", "fuse-basic")

    def work() -> None:
        model = graph.load(source)
        for name in names:
            result = PASSES.get(name)().run(model, Context(modules))
            print(f"{name}: {result.changes} changes", *result.notes, sep="\n  ")
        lost = provenance.missing(model)
        print(f"nodes without a past: {len(lost)}")
        graph.save(model, target)

    return work


def onnxsim(source: Path, target: Path, preset: str) -> Callable[[], None]:
    import onnx
    import onnxsim

    def work() -> None:
        simplified, _ = onnxsim.simplify(onnx.load(source))
        onnx.save(simplified, target)

    return work


def onnxslim(source: Path, target: Path, preset: str) -> Callable[[], None]:
    import onnx
    import onnxslim

    def work() -> None:
        slimmed = onnxslim.slim(onnx.load(source))
        if not isinstance(slimmed, onnx.ModelProto):
            raise SystemExit(f"onnxslim gave {type(slimmed).__name__}, not a model")
        onnx.save(slimmed, target)

    return work


def work_alone(tool: str, source: Path, target: Path, preset: str) -> None:
    """Run one tool here and print what it took as the last line, in JSON."""
    job = {"ours": ours, "onnxsim": onnxsim, "onnxslim": onnxslim}[tool]
    work = job(source, target, preset)
    cpu, wall = time.process_time(), time.perf_counter()
    with contextlib.redirect_stderr(io.StringIO()):
        work()
    taken = {
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.perf_counter() - wall,
    }
    print(json.dumps(taken))


def measure(tool: str, source: Path, target: Path, preset: str) -> dict[str, float]:
    """Run one tool in its own process."""
    command = [sys.executable, __file__, str(source), "--worker", tool]
    command += ["--target", str(target), "--map", preset]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        raise SystemExit(f"{tool}: {done.stderr.strip().splitlines()[-1]}")
    *said, last = done.stdout.strip().splitlines()
    if tool == "ours":
        print(*said, sep="\n")
    taken: dict[str, float] = json.loads(last)
    return taken


def session(path: Path) -> onnxruntime.InferenceSession:
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = THREADS
    options.log_severity_level = 4
    # Four arenas of a driving model side by side are 15 GB.
    options.enable_cpu_mem_arena = False
    return onnxruntime.InferenceSession(path, options)


def nodes(path: Path) -> int:
    from me2e_compress import graph

    return graph.node_count(graph.load(path))


def frames(folder: Path, count: int) -> list[Frame]:
    files = sorted(folder.glob("*.npz"))[:count]
    return [dict(np.load(file)) for file in files]


def error(want: Sequence[Any], got: Sequence[Any]) -> float:
    """Largest max|a-b| / max|a| over the outputs."""
    worst = 0.0
    for one, other in zip(want, got, strict=True):
        a, b = one.astype(np.float64), other.astype(np.float64)
        scale = float(np.abs(a).max(initial=0.0)) or 1.0
        worst = max(worst, float(np.abs(a - b).max(initial=0.0)) / scale)
    return worst


def replay(
    original: onnxruntime.InferenceSession, shown: Sequence[Frame]
) -> tuple[list[Frame], list[Any]]:
    """Run the original; a state that no frame holds starts at 0 and is fed forward."""
    names = [port.name for port in original.get_outputs()]
    state = {
        port.name: np.zeros(port.shape, np.float32)
        for port in original.get_inputs()
        if port.name not in shown[0]
    }
    feeds, wanted = [], []
    for frame in shown:
        feeds.append({**frame, **state})
        wanted.append(original.run(None, feeds[-1]))
        outputs = dict(zip(names, wanted[-1], strict=True))
        state = {name: outputs.get(f"{name}_out", state[name]) for name in state}
    return feeds, wanted


def compare(source: Path, folder: Path, preset: str) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        files = {"original": source}
        taken: dict[str, dict[str, float]] = {}
        for tool in TOOLS:
            files[tool] = Path(scratch) / f"{tool}.onnx"
            taken[tool] = measure(tool, source, files[tool], preset)
        sessions = {name: session(path) for name, path in files.items()}
        shown = frames(folder, 2)
        feeds, wanted = replay(sessions["original"], shown)
        latency: dict[str, list[float]] = {name: [] for name in sessions}
        for turn in range(ROUNDS):
            for name, one in sessions.items():
                start = time.perf_counter()
                one.run(None, feeds[turn % len(feeds)])
                latency[name].append(time.perf_counter() - start)
        print(
            f"\n{'':10}  CPU s  wall s  nodes        bytes  max rel err  min s  med s"
        )
        for name, path in files.items():
            off = max(
                error(want, sessions[name].run(None, feed))
                for want, feed in zip(wanted, feeds, strict=True)
            )
            spent = taken.get(name, {"cpu_s": 0.0, "wall_s": 0.0})
            print(
                f"{name:10} {spent['cpu_s']:6.2f} {spent['wall_s']:7.2f}"
                f" {nodes(path):6} {os.path.getsize(path):12,} {off:12.2e}"
                f" {min(latency[name]):6.3f} {np.median(latency[name]):6.3f}"
            )


def scaling() -> None:
    import onnx

    from benchmarks.synthetic import synthetic

    print("nodes in  nodes out  CPU s  CPU ms/node")
    with tempfile.TemporaryDirectory() as scratch:
        for count in (6000, 12000, 24000):
            source = Path(scratch) / "synthetic.onnx"
            model = synthetic(count)
            onnx.save(model, source)
            target = Path(scratch) / "ours.onnx"
            with contextlib.redirect_stdout(io.StringIO()):
                taken = measure("ours", source, target, "")
            cpu_s = taken["cpu_s"]
            size = len(model.graph.node)
            print(
                f"{size:8} {nodes(target):10} {cpu_s:6.2f} {1e3 * cpu_s / size:12.3f}"
            )


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path, nargs="?")
    parser.add_argument("frames", type=Path, nargs="?")
    parser.add_argument("--map", default="")
    parser.add_argument("--scaling", action="store_true")
    parser.add_argument("--worker", choices=TOOLS)
    parser.add_argument("--target", type=Path)
    given = parser.parse_args()
    if given.worker:
        work_alone(given.worker, given.model, given.target, given.map)
    elif given.scaling:
        scaling()
    elif given.model and given.frames:
        compare(given.model, given.frames, given.map)
    else:
        parser.error("name a model and its frames, or --scaling")


if __name__ == "__main__":
    main()
