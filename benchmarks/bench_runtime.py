"""VAD-tiny on this CPU in every runtime at hand, in one interleaved run.

    python -m benchmarks.bench_runtime OUT [--peer-python PYTHON] [--rounds 5]
        [--threads 2] [--frames 1] [--only "ours, int8;PyTorch, eager"]

One frame of the stack at its published size, recurrent state at zeros: a process a row,
in turn, round by round, so that whatever else runs on the machine falls on all rows.
The table gives least and median CPU time of all runs and of all threads together, the
clock, the largest resident set, the least SQNR over the outputs and that of the plan
(against onnxruntime on the file as exported), and the share of what the processor
could do: the time that the file's MACs take at the rate of onnxruntime's own products
of 2,048 x 2,048 (float32, and uint8 by int8 for what is int8) over the time they took.

OpenVINO runs in PYTHON, which needs ``openvino`` and numpy; int8 there is the file of
onnxruntime.quantization. A runtime that is missing or refuses a file is named below
the table. Files stay in OUT and are not made again.
"""

import argparse
import dataclasses
import json
import math
import statistics
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import onnx_ir as ir

from benchmarks import subjects
from benchmarks.bench_int8_cpu import macs_of_a_frame
from benchmarks.subject import Subject
from me2e_compress import graph
from me2e_compress.manager.report import versions
from me2e_compress.runtime.profile import processor
from me2e_compress.runtime.session import run_once
from me2e_compress.targets.onnxruntime import int8_layers

STACK = "vad-tiny"
REFERENCE = "onnxruntime, as exported"


@dataclasses.dataclass(frozen=True)
class Entry:
    """A row: an engine of :mod:`benchmarks.run_one`, and what it runs."""

    engine: str
    file: str
    passes: str = ""


BEFORE = "import-normalize,fold-constants,eliminate-redundant,hoist-linear"
FUSED = f"{BEFORE},fuse-operators,eliminate-redundant,fuse-basic"
INT8 = "quantize-int8{target=onnxruntime}"
ENTRIES = {
    "PyTorch, eager": Entry("torch", STACK),
    "PyTorch, torch.compile": Entry("torch-compile", STACK),
    REFERENCE: Entry("onnxruntime", "source"),
    "onnxsim + onnxruntime": Entry("onnxruntime", "onnxsim"),
    "onnxruntime.quantization": Entry("onnxruntime", "onnxruntime-int8"),
    "OpenVINO, float32": Entry("openvino-f32", "source"),
    "OpenVINO, bfloat16": Entry("openvino-bf16", "source"),
    "OpenVINO, int8": Entry("openvino-f32", "onnxruntime-int8"),
    "ours, exact": Entry("ours", "exact", f"{BEFORE},fuse-basic"),
    "ours, fused": Entry("ours", "fused", FUSED),
    "ours, int8": Entry("ours", "int8", f"{BEFORE},fuse-basic,{INT8}"),
    "ours, int8 fused": Entry("ours", "int8-fused", f"{FUSED},{INT8}"),
}


@dataclasses.dataclass
class Row:
    """What was measured of one entry."""

    cpu_s: list[float] = dataclasses.field(default_factory=list)
    wall_s: list[float] = dataclasses.field(default_factory=list)
    peak_mb: float = 0.0
    sqnr_db: dict[str, float] = dataclasses.field(default_factory=dict)


def path_of(subject: Subject, entry: Entry) -> Path:
    """Give the file that an entry runs."""
    return subject.folder / f"{entry.file}.onnx"


def made(subject: Subject, entry: Entry, frames: int) -> str | None:
    """Write the file of an entry, unless it is there; return why that failed."""
    path = path_of(subject, entry)
    if entry.file == STACK or path.is_file():
        return None
    if entry.passes:
        command = ["-m", "me2e_compress", "compress", str(subject.source), "--passes"]
        command += [entry.passes, "--frames", str(subject.frames), "-o", str(path)]
        command += ["--map", str(subject.map), "--verify-frames", "0"]
        command += ["--measure-frames", "0"]
    elif entry.file == "onnxsim":
        write = (
            "import onnx, onnxsim, sys; onnx.save(onnxsim.simplify(sys.argv[1])[0],"
            " sys.argv[2])"
        )
        command = ["-c", write, str(subject.source), str(path)]
    else:
        tool = "onnxruntime-uint8-tensor"
        command = ["benchmarks/peer.py", tool, str(subject.model)]
        command += [str(subject.frames), str(path), "--frames", str(frames)]
    done = subprocess.run(
        [sys.executable, *command], capture_output=True, text=True, check=False
    )
    return None if path.is_file() else last_line(done)


def last_line(done: "subprocess.CompletedProcess[str]") -> str:
    """Say why a child ended without what it was started for."""
    lines = done.stderr.strip().splitlines() or [f"exit {done.returncode}"]
    return lines[-1][:160]


def first_frame(subject: Subject) -> Path:
    """Write the frame that all run: recorded, its state at zeros."""
    path = subject.folder / "one-frame.npz"
    if not path.is_file():
        with np.load(next(iter(sorted(subject.held_out.glob("*.npz"))))) as held:
            arrays = dict(held)
        for value in graph.load(subject.source).graph.inputs:
            shape = graph.static_shape(value) or ()
            arrays.setdefault(str(value.name), np.zeros(shape, np.float32))
        np.savez(path, **arrays)
    return path


def run(subject: Subject, name: str, given: argparse.Namespace) -> dict[str, Any] | str:
    """Run an entry in a process of its own; return why it did not, if so."""
    entry = ENTRIES[name]
    peer = entry.engine.startswith("openvino")
    python = str(given.peer_python if peer else sys.executable)
    target = entry.file if entry.file == STACK else str(path_of(subject, entry))
    out = subject.folder / f"outputs {name}.npz"
    command = [python, "-W", "ignore", *(() if peer else ("-m",))]
    command += ["benchmarks/run_one.py" if peer else "benchmarks.run_one"]
    command += [entry.engine, target, str(first_frame(subject)), str(out)]
    command += ["--threads", str(given.threads), "--runs", str(given.runs)]
    done = subprocess.run(command, capture_output=True, text=True, check=False)
    if done.returncode:
        return last_line(done)
    answer: dict[str, Any] = json.loads(done.stdout.splitlines()[-1])
    return answer


def measured(
    subject: Subject, names: list[str], given: argparse.Namespace
) -> tuple[dict[str, Row], dict[str, str]]:
    """Run every entry in turn, round by round."""
    rows = {name: Row() for name in names}
    failed: dict[str, str] = {}
    for turn in range(given.rounds):
        for name in names:
            if name in failed:
                continue
            print(f"  round {turn + 1}: {name}", file=sys.stderr, flush=True)
            found = run(subject, name, given)
            if isinstance(found, str):
                failed[name] = found
                continue
            row = rows[name]
            row.cpu_s += found["cpu_s"]
            row.wall_s += found["wall_s"]
            row.peak_mb = max(row.peak_mb, found["peak_mb"])
    return {name: row for name, row in rows.items() if name not in failed}, failed


def fidelity(subject: Subject, name: str) -> dict[str, float]:
    """Return the SQNR of every output against the file as exported, dB."""
    with (
        np.load(subject.folder / f"outputs {REFERENCE}.npz") as reference,
        np.load(subject.folder / f"outputs {name}.npz") as other,
    ):
        return {
            output: sqnr_db(reference[output], other[output]) for output in reference
        }


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
        taken = []
        for _ in range(5):
            start = time.process_time()
            run_once(model, feeds)
            taken.append(time.process_time() - start)
        found[name] = size**3 / min(taken)
    return found


def shares(subject: Subject, rates: dict[str, float]) -> Iterator[tuple[str, float]]:
    """Return the least CPU seconds that the MACs of our files and the export take."""
    for name, entry in ENTRIES.items():
        path = path_of(subject, entry)
        if entry.engine not in ("ours", "onnxruntime") or not path.is_file():
            continue
        model = graph.load(path)
        every = macs_of_a_frame(model, model.graph)
        int8 = macs_of_a_frame(model, int8_layers(model))
        yield name, (every - int8) / rates["float32"] + int8 / rates["int8"]


def table(subject: Subject, rows: dict[str, Row], rates: dict[str, float]) -> str:
    """Write the table."""
    plan, floor = "ego_fut_preds", dict(shares(subject, rates))
    eager = min(next(iter(rows.values())).cpu_s)
    lines = [
        "| | CPU s, least | median | x first row | wall s, least | peak MB"
        " | worst SQNR, dB | plan, dB | share of peak |",
        "|---|---:|---:|---:|---:|---:|---:|---:|---:|",
    ]
    for name, row in rows.items():
        least, found = min(row.cpu_s), row.sqnr_db
        share = f"{floor[name] / least:.0%}" if name in floor else "-"
        lines.append(
            f"| {name} | {least:.2f} | {statistics.median(row.cpu_s):.2f}"
            f" | {eager / least:.2f} | {min(row.wall_s):.2f} | {row.peak_mb:.0f}"
            f" | {min(found.values()):.1f} | {found[plan]:.1f} | {share} |"
        )
    return "\n".join(lines)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--peer-python", type=Path, default=Path(sys.executable))
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--runs", type=int, default=2)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--frames", type=int, default=1)
    parser.add_argument("--only", default="", help="rows, joined by ;")
    given = parser.parse_args()
    subject = subjects.make(STACK, given.out, given.frames)
    wanted = [each.strip() for each in given.only.split(";")] if given.only else []
    names = [name for name in ENTRIES if not wanted or name in (*wanted, REFERENCE)]
    failed = {
        name: reason
        for name in names
        if (reason := made(subject, ENTRIES[name], given.frames)) is not None
    }
    rows, refused = measured(
        subject, [name for name in names if name not in failed], given
    )
    for name, row in rows.items():
        row.sqnr_db = fidelity(subject, name)
    rates = peaks()
    print(
        f"{processor()}, {given.threads} threads, {given.rounds} rounds; {versions()}"
    )
    print(", ".join(f"{k}: {v / 1e9:.0f} GMAC/CPU s" for k, v in rates.items()) + "\n")
    print(table(subject, rows, rates))
    for name, reason in {**failed, **refused}.items():
        print(f"\n{name}: {reason}")


if __name__ == "__main__":
    main()
