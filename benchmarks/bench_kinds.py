"""Eleven kinds of model at the door: opened, simplified, quantized, beside the peers.

    python -m benchmarks.bench_kinds OUT [--only vit,detr] [--peer-python PYTHON]

The models are those of :mod:`benchmarks.model_kinds` (extra ``models``). First every
tool simplifies what was exported: nodes, bytes with the weights beside the graph, CPU
seconds, and the largest relative error of an output on frames that are held out,
against the source with all of onnxruntime's optimizations off. Then ours and the peers
quantize the graph after our exact passes, as :mod:`benchmarks.bench_int8_cpu` does and
with its files. PYTHON is one that ModelOpt is installed for. Rows are printed as they
come, and ``OUT/kinds.md`` holds both tables.
"""

import argparse
import dataclasses
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import onnxruntime

from benchmarks import bench_exact_passes as simplifiers
from benchmarks import bench_int8_cpu as quantizers
from benchmarks import subjects
from benchmarks.model_kinds import KINDS
from me2e_compress import graph

SIMPLIFIERS = ("ours", "onnxsim", "onnxslim")
FLOAT, OURS, ORT, MODELOPT = "float", "ours", "onnxruntime uint8", "ModelOpt"
OTHERS = {*quantizers.PEERS, *quantizers.OURS} - {OURS, ORT, MODELOPT}
"""What the other benchmark measures and this table has no column for."""


@dataclasses.dataclass(frozen=True)
class Simplified:
    """What one tool made of a graph.

    Attributes:
        nodes: subgraphs included.
        megabytes: weights in files beside the graph included.
        cpu_s: of the work, start-up apart.
        error: largest max|a - b| / max|a| of an output.
    """

    nodes: int
    megabytes: float
    cpu_s: float
    error: float


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--only", default=",".join(KINDS))
    parser.add_argument("--peer-python", type=Path, default=Path(sys.executable))
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    graphs, int8 = [GRAPH_HEAD], [INT8_HEAD]
    for name in chosen.only.split(","):
        subject = subjects.make(name, chosen.out, 4)
        graphs.append(graph_row(subject))
        print(graphs[-1], flush=True)
        int8.append(int8_row(subject, chosen))
        print(int8[-1], flush=True)
        lines = "\n".join([*graphs, "", *int8, ""])
        (chosen.out / "kinds.md").write_text(lines, encoding="utf-8")


GRAPH_HEAD = """
| model | nodes, MB | ours | onnxsim | onnxslim | error of ours |
|---|---|---|---|---|---|"""
INT8_HEAD = """
| model | float MB, CPU ms | ours: MB, ms, dB | onnxruntime.quantization | ModelOpt |
|---|---|---|---|---|"""


def graph_row(subject: subjects.Subject) -> str:
    """Let every tool simplify one graph, and tell nodes, MB and CPU seconds."""
    frames = simplifiers.frames(subject.held_out, 1)
    wanted = answers(subject.source, frames, optimized=False)
    found = {name: simplified(name, subject, frames, wanted) for name in SIMPLIFIERS}
    cells = [
        each
        if isinstance(each, str)
        else f"{each.nodes}, {each.megabytes:.1f}, {each.cpu_s:.1f} s"
        for each in found.values()
    ]
    source = graph.node_count(graph.load(subject.source))
    ours = found["ours"]
    error = "" if isinstance(ours, str) else f"{ours.error:.1e}"
    size = megabytes(subject.source)
    return f"| {subject.name} | {source}, {size:.1f} | {' | '.join(cells)} | {error} |"


def simplified(
    tool: str,
    subject: subjects.Subject,
    frames: Sequence[simplifiers.Frame],
    wanted: Sequence[Sequence[Any]],
) -> Simplified | str:
    """Run one tool and measure its file; a text says why there is none."""
    target = subject.folder / f"simplified-by-{tool}.onnx"
    job = simplifiers.Job(subject.source, target, str(subject.map), None)
    try:
        taken = simplifiers.measure(tool, job)
        got = answers(target, frames, optimized=True)
    except (SystemExit, RuntimeError) as failed:
        return f"failed: {str(failed)[:80]}"
    worst = max(map(simplifiers.error, wanted, got))
    nodes = graph.node_count(graph.load(target))
    return Simplified(nodes, megabytes(target), taken.cpu_s, worst)


def answers(
    path: Path, frames: Sequence[simplifiers.Frame], *, optimized: bool
) -> list[list[Any]]:
    """Run a file over frames."""
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = simplifiers.THREADS
    options.log_severity_level = 4
    if not optimized:
        none = onnxruntime.GraphOptimizationLevel.ORT_DISABLE_ALL
        options.graph_optimization_level = none
    session = onnxruntime.InferenceSession(path, options)
    return [list(session.run(None, frame)) for frame in frames]


def megabytes(path: Path) -> float:
    """Add up a graph and the weights beside it."""
    beside = path.with_name(path.name + ".data")
    return sum(e.stat().st_size for e in (path, beside) if e.is_file()) / 1e6


def int8_row(subject: subjects.Subject, chosen: argparse.Namespace) -> str:
    """Let ours and the peers quantize one graph, and tell MB, CPU ms and SQNR."""
    given = argparse.Namespace(
        without=";".join(OTHERS),
        frames=4,
        threads=simplifiers.THREADS,
        limit_gb=14.0,
        rounds=chosen.rounds,
        peer_python=chosen.peer_python,
    )
    names, missing = quantizers.files(subject, given)
    rows = quantizers.measure(subject, names, missing, given)
    cells = []
    for name in (OURS, ORT, MODELOPT):
        row = rows.get(name)
        if row is None:
            cells.append(missing.get(name, "-")[:80])
        else:
            db = min(row.sqnr_db.values())
            cells.append(f"{row.megabytes:.1f}, {ms(row)}, {db:.1f}")
    plain = rows[FLOAT]
    return (
        f"| {subject.name} | {plain.megabytes:.1f}, {ms(plain)} | {' | '.join(cells)} |"
    )


def ms(row: quantizers.Row) -> str:
    """Tell the least CPU time of a frame in milliseconds."""
    return f"{min(row.cpu_s) * 1e3:.1f}"


if __name__ == "__main__":
    main()
