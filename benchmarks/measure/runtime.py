"""A model on this CPU in every runtime at hand, in one interleaved run.

    python -m benchmarks.measure.runtime OUT [--peer-python PYTHON] [--rounds 5]
        [--threads 2] [--frames 8] [--only "ours, exact;OpenVINO, bfloat16"]
        [--freeze-inputs] [--with torch.compile] [--prepare] [--stack NAME]

One frame of a stack at its published size, recurrent state at zeros, is timed: a
process a row, in turn, round by round, so that whatever else runs on the machine falls
on all rows. The table gives least and median CPU time of all runs and of all threads
together, the clock, the largest resident set, what its file took to be made (CPU s),
and the share of what the processor could do: the time that the file's MACs take at the
rate of onnxruntime's own products of 2,048 x 2,048 (float32, and uint8 by int8 for what
is int8) over the time they took. Its SQNR, and that of a second table, output by
output, is of all held-out frames together, each with the state that the exported file
gave, against onnxruntime on that file; an output of whole numbers has none, and the
mean is of outputs that differ. Beside the plan's stands how far it moves at most, in
its unit.

OpenVINO and NNCF run in PYTHON; without that option the command makes a virtual
environment of pinned versions in OUT (:mod:`benchmarks.tools.peer_environment`). NNCF
quantizes the exported file, by its defaults and as a user would by hand
(:mod:`benchmarks.tools.quantize_nncf`). A runtime that is missing or refuses a file is
named below the tables. Files stay in OUT and are not made again; ``--prepare`` writes
them, and measures nothing.

The cameras' matrices are an input. With ``--freeze-inputs`` they are constants, for
every file: others read the exported file after our passes ``freeze-inputs`` and
``fold-constants``; PyTorch has no such pass and runs what it always does. SQNR is still
that against the file as exported.

``vad-tiny-original`` is VAD-tiny as the published code writes it
(:mod:`benchmarks.subjects.original_patterns`); ``deformable-detr`` needs transformers;
it and ``highway``, the driver that ships, have no PyTorch row.
"""

import argparse
import dataclasses
import math
import statistics
import sys
from collections.abc import Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir

from benchmarks.measure.int8_cpu import macs_of_a_frame
from benchmarks.subjects import subjects
from benchmarks.subjects.runtime_files import (
    ENTRIES,
    OPTIONAL,
    PLANS,
    REFERENCE,
    TORCH,
    WITHOUT_TORCH,
    Entry,
    made,
    made_cpu_s,
    path_of,
    static,
    whole_frames,
)
from benchmarks.subjects.subject import Subject
from benchmarks.tools.peer_environment import peer_python, peer_versions
from benchmarks.tools.processes import answer, in_turn
from me2e_compress import graph
from me2e_compress.manager.report import versions
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.session import run_once
from me2e_compress.targets.onnxruntime.convert import int8_layers


@dataclasses.dataclass
class Row:
    """What was measured of one entry."""

    cpu_s: list[float] = dataclasses.field(default_factory=list)
    wall_s: list[float] = dataclasses.field(default_factory=list)
    peak_mb: float = 0.0
    sqnr_db: dict[str, float] = dataclasses.field(default_factory=dict)
    plan_moves: float = math.nan


def run(
    subject: Subject, entry: Entry, given: argparse.Namespace, *, answers: bool
) -> dict[str, Any] | str:
    """Run an entry in a process of its own; return why it did not, if so.

    ``answers`` keeps what it answers to all frames.
    """
    python = str(given.peer_python if entry.peer else sys.executable)
    stack = entry.engine in TORCH
    target = subject.name if stack else str(path_of(subject, entry))
    command = [python, "-W", "ignore", "-m", "benchmarks.tools.run_one"]
    command += [entry.engine, target, str(whole_frames(subject))]
    command += ["--out", str(answers_of(subject, entry))] if answers else []
    command += ["--threads", str(given.threads), "--runs", str(given.runs)]
    return answer(command)


def answers_of(subject: Subject, entry: Entry) -> Path:
    """Give the file of what an entry answered."""
    return subject.folder / f"outputs {entry.engine} {entry.file}.npz"


def measured(
    subject: Subject, entries: Mapping[str, Entry], given: argparse.Namespace
) -> tuple[dict[str, Row], dict[str, str]]:
    """Run every entry in turn, round by round."""
    rows = {name: Row() for name in entries}
    failed: dict[str, str] = {}
    for turn in range(given.rounds):
        for name, entry in entries.items():
            if name in failed:
                continue
            print(f"  round {turn + 1}: {name}", file=sys.stderr, flush=True)
            found = run(subject, entry, given, answers=not turn)
            if isinstance(found, str):
                failed[name] = found
                continue
            row = rows[name]
            row.cpu_s += found["cpu_s"]
            row.wall_s += found["wall_s"]
            row.peak_mb = max(row.peak_mb, found["peak_mb"])
    return {name: row for name, row in rows.items() if name not in failed}, failed


def judge(subject: Subject, row: Row, entry: Entry, expected: Entry) -> None:
    """Set how far a row's outputs are from the file as exported."""
    plan = PLANS[subject.name]
    with (
        np.load(answers_of(subject, expected)) as reference,
        np.load(answers_of(subject, entry)) as other,
    ):
        row.sqnr_db = {
            output: sqnr_db(array, other[output])
            for output, array in reference.items()
            if np.issubdtype(array.dtype, np.floating)
        }
        if plan:
            row.plan_moves = float(np.abs(reference[plan] - other[plan]).max())


def sqnr_db(reference: Any, other: Any) -> float:
    """Return 10 log10(sum a^2 / sum (a - b)^2), in float64."""
    wide = np.asarray(reference, np.float64)
    noise = float(np.square(wide - np.asarray(other, np.float64)).sum())
    return 10 * math.log10(float(np.square(wide).sum()) / noise) if noise else math.inf


def peaks(size: int = 2048) -> dict[str, float]:
    """Measure MACs a CPU second of large products, in float32 and in int8."""
    draws = np.random.default_rng(0)
    text = (
        '<ir_version: 9, opset_import: ["" : 17]> m ({left} a, {right} b) => ({out} y)'
        " {{ y = {op}(a, b) }}"
    )
    shape = f"[{size},{size}]"
    found = {}
    for name, left, right, out, op in (
        ("float32", "float", "float", "float", "MatMul"),
        ("int8", "uint8", "int8", "int32", "MatMulInteger"),
    ):
        types = {"left": left + shape, "right": right + shape, "out": out + shape}
        model = ir.from_onnx_text(text.format(op=op, **types))
        feeds = {
            key: draws.integers(1, 100, (size, size)).astype(kind)
            for key, kind in (("a", left), ("b", right))
        }
        feeds = {
            key: array.astype(np.float32) if name == "float32" else array
            for key, array in feeds.items()
        }
        (taken,) = in_turn({name: partial(run_once, model, feeds)}, 5).values()
        found[name] = size**3 / min(taken)
    return found


def shares(
    subject: Subject, entries: Mapping[str, Entry], rates: dict[str, float]
) -> Iterator[tuple[str, float]]:
    """Return the least CPU seconds that the MACs of our files and the export take."""
    for name, entry in entries.items():
        path = path_of(subject, entry)
        if entry.engine not in ("ours", "onnxruntime") or not path.is_file():
            continue
        model = graph.load(path)
        every = macs_of_a_frame(model, model.graph)
        int8 = macs_of_a_frame(model, int8_layers(model))
        yield name, (every - int8) / rates["float32"] + int8 / rates["int8"]


def table(
    rows: dict[str, Row],
    floor: Mapping[str, float],
    made_s: Mapping[str, float],
    plan: str,
) -> str:
    """Write the table.

    Args:
        rows: what was measured; the others are compared with the reference, or with
            the first where that did not run.
        floor: least CPU seconds that the MACs of a row take, where they are known.
        made_s: CPU seconds that the file of a row took, where it was made.
        plan: the output that is the plan; empty if there is none.
    """
    first = min(rows.get(REFERENCE, next(iter(rows.values()))).cpu_s)
    lines = [
        "| | CPU s, least | median | of float's | wall s, least | peak MB | made, CPU s"
        " | SQNR dB, least | mean | plan | plan moves | share of peak |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, row in rows.items():
        least, found = min(row.cpu_s), row.sqnr_db
        share = f"{floor[name] / least:.0%}" if name in floor else "-"
        at_plan = f"{found[plan]:.1f}" if plan else "-"
        finite = [db for db in found.values() if math.isfinite(db)]
        mean = statistics.fmean(finite) if finite else math.inf
        lines.append(
            f"| {name} | {least:.4f} | {statistics.median(row.cpu_s):.4f}"
            f" | {least / first:.2f} | {min(row.wall_s):.4f} | {row.peak_mb:.0f}"
            f" | {made_s.get(name, '-')} | {min(found.values()):.1f} | {mean:.1f}"
            f" | {at_plan} | {row.plan_moves:.3f} | {share} |"
        )
    return "\n".join(lines)


def outputs_table(rows: dict[str, Row]) -> str:
    """Write the SQNR of every output, dB."""
    outputs = list(next(iter(rows.values())).sqnr_db)
    lines = ["| | " + " | ".join(outputs) + " |", "|---|" + "---:|" * len(outputs)]
    for name, row in rows.items():
        cells = (f"{row.sqnr_db[output]:.1f}" for output in outputs)
        lines.append(f"| {name} | {' | '.join(cells)} |")
    return "\n".join(lines)


def parser() -> argparse.ArgumentParser:
    """Return what reads the command line."""
    found = argparse.ArgumentParser(description=__doc__)
    found.add_argument("out", type=Path)
    found.add_argument("--peer-python", type=Path, help="has openvino, nncf, numpy")
    found.add_argument("--rounds", type=int, default=5)
    found.add_argument("--runs", type=int, default=2)
    found.add_argument("--threads", type=int, default=2)
    found.add_argument("--frames", type=int, default=8, help="to calibrate on")
    found.add_argument("--only", default="", help="rows, joined by ;")
    found.add_argument("--freeze-inputs", action="store_true")
    found.add_argument(
        "--with", action="append", choices=OPTIONAL, default=[], dest="optional"
    )
    found.add_argument("--stack", choices=PLANS, default="vad-tiny")
    found.add_argument("--prepare", action="store_true", help="write files, and end")
    return found


def main() -> None:
    given = parser().parse_args()
    subject = subjects.make(given.stack, given.out, given.frames)
    entries = chosen(given)
    peers = any(entry.peer for entry in entries.values())
    if peers and given.peer_python is None:
        given.peer_python = peer_python(given.out / "peer-python")
    failed: dict[str, str] = {}
    for name, entry in entries.items():
        if reason := made(subject, entry, given.frames, given.peer_python):
            failed[name] = reason
    if not given.prepare:
        there = {name: each for name, each in entries.items() if name not in failed}
        failed |= show(subject, there, given)
    for name, reason in failed.items():
        print(f"\n{name}: {reason}")


def chosen(given: argparse.Namespace) -> dict[str, Entry]:
    """Return the rows that are asked for, the reference always."""
    wanted = [each.strip() for each in given.only.split(";")] if given.only else []
    left_out = set(OPTIONAL.values()) - {OPTIONAL[each] for each in given.optional}
    entries = static(ENTRIES) if given.freeze_inputs else ENTRIES
    if given.stack in WITHOUT_TORCH:
        left_out |= {name for name, entry in entries.items() if entry.engine in TORCH}
    return {
        name: entry
        for name, entry in entries.items()
        if (name in (*wanted, REFERENCE) if wanted else name not in left_out)
    }


def show(
    subject: Subject, entries: dict[str, Entry], given: argparse.Namespace
) -> dict[str, str]:
    """Measure rows and print their table; return those that did not run, and why."""
    rows, refused = measured(subject, entries, given)
    # Where onnxruntime refuses what was exported, ours after the exact passes
    expected = ENTRIES["ours, exact" if REFERENCE in refused else REFERENCE]
    if not answers_of(subject, expected).is_file():
        run(subject, expected, given, answers=True)
    for name, row in rows.items():
        judge(subject, row, entries[name], expected)
    rates = peaks()
    peers = peer_versions(given.peer_python) if given.peer_python else ""
    print(
        f"{processor()}, {given.threads} threads, {given.rounds} rounds; {versions()};"
        f" peers: {peers or 'none'}"
    )
    print(", ".join(f"{k}: {v / 1e9:.0f} GMAC/CPU s" for k, v in rates.items()) + "\n")
    seconds = made_cpu_s(subject)
    files = {name: path_of(subject, entries[name]).name for name in rows}
    made_s = {name: seconds[file] for name, file in files.items() if file in seconds}
    floor = dict(shares(subject, entries, rates))
    print(table(rows, floor, made_s, PLANS[subject.name]) + "\n")
    print(outputs_table(rows))
    return refused


if __name__ == "__main__":
    main()
