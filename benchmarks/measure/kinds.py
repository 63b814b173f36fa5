"""Eleven kinds of model at the door: opened, simplified, quantized, beside the peers.

    python -m benchmarks.measure.kinds OUT [--only vit,detr] [--peer-python PYTHON]

The models are those of :mod:`benchmarks.subjects.model_kinds` (transformers). First
every tool simplifies what was exported: nodes, MB with the weights beside the graph,
CPU seconds of the work, and the largest relative error of an output on a frame that is
held out, against torch. Then ours and the peers quantize the graph after our exact
passes, as :mod:`benchmarks.measure.int8_cpu` does and with its files. PYTHON is one
that ModelOpt is installed for. Rows are printed as they come, and ``OUT/kinds.md``
holds both tables.
"""

import argparse
import sys
from pathlib import Path

import numpy as np

from benchmarks.measure import exact_passes as exact
from benchmarks.measure import int8_cpu as quantizers
from benchmarks.subjects import subjects
from benchmarks.subjects.model_kinds import KINDS, expected
from benchmarks.tools import simplifiers
from me2e_compress import graph
from me2e_compress.runtime.session import REFUSALS

FAILED: tuple[type[BaseException], ...] = (SystemExit, *REFUSALS)
SIMPLIFIERS = ("ours", "onnxsim", "onnxslim")
FLOAT, OURS, ORT, MODELOPT = "float", "ours", "onnxruntime uint8", "ModelOpt"
OTHERS = {*quantizers.PEERS, *quantizers.OURS} - {OURS, ORT, MODELOPT}
"""What the other benchmark measures and this table has no column for."""


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
| model | nodes, MB | ours: nodes, MB, s, error | onnxsim | onnxslim |
|---|---|---|---|---|"""
INT8_HEAD = """
| model | float MB, CPU ms | ours: MB, ms, dB | onnxruntime.quantization | ModelOpt |
|---|---|---|---|---|"""


def graph_row(subject: subjects.Subject) -> str:
    """Let every tool simplify one graph; tell nodes, MB, CPU seconds and error."""
    cells = [simplified(name, subject) for name in SIMPLIFIERS]
    source = graph.node_count(graph.load(subject.source))
    size = graph.file_bytes(subject.source) / 1e6
    return f"| {subject.name} | {source}, {size:.1f} | {' | '.join(cells)} |"


def simplified(tool: str, subject: subjects.Subject) -> str:
    """Run one tool and measure its file, or say why there is none."""
    target = subject.folder / f"simplified-by-{tool}.onnx"
    job = simplifiers.Job(subject.source, target, str(subject.map), None)
    try:
        taken = simplifiers.measure(tool, job)
        error = error_of(target, subject)
    except FAILED as failed:
        return f"failed: {str(failed)[:100]}"
    nodes = graph.node_count(graph.load(target))
    return (
        f"{nodes}, {graph.file_bytes(target) / 1e6:.1f}, {taken.cpu_s:.1f}, {error:.1e}"
    )


def error_of(path: Path, subject: subjects.Subject) -> float:
    """Return the largest max|a - b| / max|a| of an output, ``a`` being torch's."""
    (frame,) = exact.frames(subject.held_out, 1)
    with np.load(expected(subject.source)) as held:
        wanted = [held[name] for name in held]
    session = exact.session(path)
    return exact.error(wanted, list(session.run(None, frame)))


def int8_row(subject: subjects.Subject, chosen: argparse.Namespace) -> str:
    """Let ours and the peers quantize one graph, and tell MB, CPU ms and SQNR."""
    given = argparse.Namespace(
        without=";".join(OTHERS),
        frames=4,
        held_out=2,
        threads=exact.THREADS,
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
