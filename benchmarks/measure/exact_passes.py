"""Recipe ``exact`` against its peers: time, memory, nodes, bytes, error, latency.

    python -m benchmarks.measure.exact_passes model.onnx frames/ --map vad
    python -m benchmarks.measure.exact_passes --scaling

Each tool works in a started process of its own, from file to file, round by round in
turn. Ours is what a user runs: the workflow ``compress``, the manager's checks, report
and hashes included. Three numbers are kept apart: start-up (the CPU time until the
imports are done), the work, and verification (what two frames add to it). Latencies
are interleaved too: round by round every graph runs one frame.
"""

import argparse
import os
import tempfile
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnxruntime

from benchmarks.tools.simplifiers import TOOLS, Job, Taken, measure

ROUNDS = 12
THREADS = 2
Frame = dict[str, npt.NDArray[np.generic]]


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


def compare(source: Path, folder: Path, preset: str, rounds: int) -> None:
    with tempfile.TemporaryDirectory() as scratch:
        files = {"original": source}
        files |= {tool: Path(scratch) / f"{tool}.onnx" for tool in TOOLS}
        taken: dict[str, list[Taken]] = {tool: [] for tool in TOOLS}
        for _ in range(rounds):
            for tool, runs in taken.items():
                runs.append(measure(tool, Job(source, files[tool], preset, folder)))
        show_times(taken)
        show_graphs(files, frames(folder, 2))


def show_times(taken: Mapping[str, Sequence[Taken]]) -> None:
    """Print the least and the median CPU time of the rounds, start-up apart."""
    print(f"\n{'':17}  start-up  CPU s min  median  wall s min  peak MB")
    for tool, runs in taken.items():
        cpu = [each.cpu_s for each in runs]
        print(
            f"{tool:17} {min(each.startup_s for each in runs):9.2f} {min(cpu):10.2f}"
            f" {np.median(cpu):7.2f} {min(each.wall_s for each in runs):11.2f}"
            f" {max(each.peak_mb for each in runs):8.0f}"
        )
    ratios = [
        mine.cpu_s / theirs.cpu_s
        for mine, theirs in zip(taken["ours"], taken["onnxsim"], strict=True)
    ]
    print(f"ours / onnxsim, round by round: {np.median(ratios):.2f} (median)")


def show_graphs(files: Mapping[str, Path], shown: Sequence[Frame]) -> None:
    """Print size, error and latency of every graph."""
    sessions = {name: session(path) for name, path in files.items()}
    feeds, wanted = replay(sessions["original"], shown)
    latency: dict[str, list[float]] = {name: [] for name in sessions}
    for turn in range(ROUNDS):
        for name, one in sessions.items():
            start = time.perf_counter()
            one.run(None, feeds[turn % len(feeds)])
            latency[name].append(time.perf_counter() - start)
    print(f"\n{'':17}  nodes        bytes  max rel err  min s  med s")
    for name, path in files.items():
        off = max(
            error(want, sessions[name].run(None, feed))
            for want, feed in zip(wanted, feeds, strict=True)
        )
        print(
            f"{name:17} {nodes(path):6} {os.path.getsize(path):12,} {off:12.2e}"
            f" {min(latency[name]):6.3f} {np.median(latency[name]):6.3f}"
        )


def scaling() -> None:
    import onnx

    from benchmarks.subjects.synthetic import synthetic

    print("nodes in  nodes out  CPU s  CPU ms/node")
    with tempfile.TemporaryDirectory() as scratch:
        for count in (6000, 12000, 24000):
            source = Path(scratch) / "synthetic.onnx"
            model = synthetic(count)
            onnx.save(model, source)
            target = Path(scratch) / "ours.onnx"
            cpu_s = measure("ours", Job(source, target, "", None)).cpu_s
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
    parser.add_argument("--rounds", type=int, default=3)
    given = parser.parse_args()
    if given.scaling:
        scaling()
    elif given.model and given.frames:
        compare(given.model, given.frames, given.map, given.rounds)
    else:
        parser.error("name a model and frames, or --scaling")


if __name__ == "__main__":
    main()
