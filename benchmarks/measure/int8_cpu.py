"""Int8 on onnxruntime's CPU: our files beside those of other tools, in one run.

    python -m benchmarks.measure.int8_cpu OUT [--subjects resnet50,vad-tiny]
        [--peer-python PYTHON] [--frames 2] [--held-out 2] [--rounds 4]

Every tool quantizes the same graph, after the exact passes, with the same frames, all
modules; the frames compared on are of another seed. Files stay in OUT and are not made
again. Latency is one frame, recurrent state at zeros: a process a file, in turn, round
by round; least CPU and wall time over all rounds. Kernels are counted in the graph as
onnxruntime's optimizer leaves it. MACs count as int8 where both operands come through
a DequantizeLinear, whatever the kernel; what follows from constants alone is left out
on both sides, since no frame changes it. ``compare`` tells the signal to noise ratio.

A tool that takes more than --limit-gb, or leaves the machine less than 2 GB, is
stopped; one that is not installed is skipped; a file that onnxruntime cannot run is not
timed. The table says so.
"""

import argparse
import dataclasses
import json
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import onnx_ir as ir

from benchmarks.measure.calibration import watch
from benchmarks.subjects import subjects
from benchmarks.tools.layer_timing import time_interleaved
from benchmarks.tools.peer import peak_mb
from benchmarks.tools.processes import answer, has_modelopt
from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.compare import compare
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import constant_values
from me2e_compress.passes import Context, Pass
from me2e_compress.passes.convert_float32 import ConvertFloat32
from me2e_compress.passes.lower_int8 import LowerInt8
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session
from me2e_compress.targets.onnxruntime.convert import int8_layers

FLOAT = "float"
PEERS = {
    "onnxruntime int8": "onnxruntime",
    "onnxruntime uint8": "onnxruntime-uint8",
    "onnxruntime uint8, one scale a weight": "onnxruntime-uint8-tensor",
    "ModelOpt": "modelopt",
}
OURS: dict[str, tuple[str, Pass]] = {
    "ours for TensorRT, rules paper": (
        FLOAT,
        QuantizeInt8(rules="paper", target="tensorrt"),
    ),
    "ours": (FLOAT, QuantizeInt8(target="onnxruntime")),
    "ours, weights to nearest": (FLOAT, QuantizeInt8(rules="safe{balance=false}")),
    "ours, rules paper": (FLOAT, QuantizeInt8(target="onnxruntime", rules="paper")),
    "ModelOpt, lowered": ("ModelOpt", LowerInt8()),
}
"""What each is made of, and how."""

KERNELS = ("QLinearConv", "QLinearMatMul", "QGemm", "MatMulIntegerToFloat")
RUNS = 3
"""Measured runs of a process, after one that is not."""


@dataclasses.dataclass
class Row:
    """One file."""

    megabytes: float
    int8_macs: float | None
    kernels: int
    sqnr_db: dict[str, float]
    cpu_s: list[float] = dataclasses.field(default_factory=list)
    wall_s: list[float] = dataclasses.field(default_factory=list)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--subjects", default="resnet50,vad-tiny")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--held-out", type=int, default=2)
    parser.add_argument("--rounds", type=int, default=4)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--limit-gb", type=float, default=14)
    parser.add_argument("--peer-python", type=Path, default=Path(sys.executable))
    parser.add_argument("--without", default="", help="files to leave out, joined by ;")
    parser.add_argument("--child", choices=("make", "weigh", "time"))
    parser.add_argument("--file", default="")
    chosen = parser.parse_args()
    if chosen.child:
        job = {"make": make, "weigh": weigh, "time": clock}[chosen.child]
        print(json.dumps(job(chosen)))
        return
    chosen.out.mkdir(parents=True, exist_ok=True)
    for name in chosen.subjects.split(","):
        held_out = max(chosen.held_out, subjects.HELD_OUT)
        subject = subjects.make(name, chosen.out, chosen.frames, held_out)
        print(f"\n{name}, {chosen.frames} frames, {chosen.threads} threads", flush=True)
        done, missing = files(subject, chosen)
        show(measure(subject, done, missing, chosen), missing)


def path_of(subject: subjects.Subject, name: str) -> Path:
    """Give the file of one tool."""
    if name == FLOAT:
        return subject.model
    return subject.folder / f"int8 {name}.onnx".replace(" ", "-").replace(",", "")


def files(
    subject: subjects.Subject, chosen: argparse.Namespace
) -> tuple[list[str], dict[str, str]]:
    """Let every tool write its file; name those that did, and why others did not."""
    done, missing = [FLOAT], {}
    left_out = [each.strip() for each in chosen.without.split(";")]
    for name in [each for each in (*PEERS, *OURS) if each not in left_out]:
        path, took = path_of(subject, name), "it is there"
        if not path.is_file():
            took = written(subject, name, chosen)
            print(f"  {name}: {took}", flush=True)
        if path.is_file():
            keep_metadata(subject.model, path)
            done.append(name)
        else:
            missing[name] = took
    return done, missing


def keep_metadata(source: Path, path: Path) -> None:
    """Say in a file what its source says: ModelOpt drops which inputs are a state."""
    said, model = graph.load(source).metadata_props, graph.load(path)
    if any(key not in model.metadata_props for key in said):
        model.metadata_props.update(said)
        graph.save(model, path)


def written(subject: subjects.Subject, name: str, chosen: argparse.Namespace) -> str:
    """Run one tool in a process of its own; say what it took, or why it did not."""
    if name in PEERS:
        tool = PEERS[name]
        python = chosen.peer_python if tool == "modelopt" else Path(sys.executable)
        if tool == "modelopt" and not has_modelopt(python):
            return f"skipped, not installed for {python}"
        command = [str(python), "-W", "ignore", "benchmarks/tools/peer.py", tool]
        command += [str(subject.model), str(subject.frames)]
        command += [str(path_of(subject, name)), "--frames", str(chosen.frames)]
        found = watch(command, chosen.limit_gb)
    elif not path_of(subject, OURS[name][0]).is_file():
        return f"skipped, there is no file of {OURS[name][0]}"
    else:
        found = watch(own(subject, "make", name, chosen), chosen.limit_gb)
    if isinstance(found, str):
        return found
    if found.cpu_s is None:
        return f"stopped at {found.peak_mb / 1024:.1f} GB"
    return f"{found.cpu_s:.1f} s CPU, {found.peak_mb:.0f} MB peak"


def own(
    subject: subjects.Subject, job: str, name: str, chosen: argparse.Namespace
) -> list[str]:
    """Give the command of a child process."""
    command = [sys.executable, "-m", "benchmarks.measure.int8_cpu", str(subject.folder)]
    command += ["--child", job, "--file", name, "--threads", str(chosen.threads)]
    command += ["--held-out", str(chosen.held_out)]
    return [*command, "--frames", str(chosen.frames)]


def make(chosen: argparse.Namespace) -> dict[str, float]:
    """Write one of our files."""
    subject = subjects.at(chosen.out)
    source, step = OURS[chosen.file]
    cpu, wall = time.process_time(), time.perf_counter()
    modules, frames = ModuleMap.load(str(subject.map)), CalibrationSet(subject.frames)
    model = graph.load(path_of(subject, source))
    if any(value.dtype == ir.DataType.FLOAT16 for value in model.graph.inputs):
        model = ConvertFloat32().run(model, Context(modules)).model
    result = step.run(model, Context(modules, frames)).model
    graph.save(result, path_of(subject, chosen.file))
    return {
        "cpu_s": time.process_time() - cpu,
        "wall_s": time.perf_counter() - wall,
        "peak_mb": peak_mb(),
    }


def measure(
    subject: subjects.Subject,
    names: list[str],
    missing: dict[str, str],
    chosen: argparse.Namespace,
) -> dict[str, Row]:
    """Weigh every file, then time in turn those that run."""
    rows = {}
    for name in names:
        found = ask(own(subject, "weigh", name, chosen))
        if "refused" in found:
            missing[name] = f"does not run: {found['refused']}"
        else:
            rows[name] = Row(**found)
    for _ in range(chosen.rounds):
        for name, row in rows.items():
            found = ask(own(subject, "time", name, chosen))
            row.cpu_s += found["cpu_s"]
            row.wall_s += found["wall_s"]
    return rows


def ask(command: list[str]) -> dict[str, Any]:
    """Run a child and read its answer."""
    found = answer(command)
    if isinstance(found, str):
        raise SystemExit(found)
    return found


def weigh(chosen: argparse.Namespace) -> dict[str, object]:
    """Measure what a file is: bytes, int8 layers and kernels, fidelity."""
    subject = subjects.at(chosen.out)
    path = path_of(subject, chosen.file)
    source, model = graph.load(subject.model), graph.load(path)
    total = macs_of_a_frame(source, source.graph)
    int8 = macs_of_a_frame(model, int8_layers(model))
    with tempfile.TemporaryDirectory() as folder:
        rewritten = Path(folder) / "rewritten.onnx"
        try:
            session = Session(
                path, threads=chosen.threads, int8_kernels=True, rewritten=rewritten
            )
        except GraphError as error:
            return {"refused": str(error)}
        kernels = Counter(node.op_type for node in graph.load(rewritten).graph)
    found = {}
    if chosen.file != FLOAT:
        recorded = CalibrationSet(subject.held_out)
        frames = [recorded[at] for at in range(chosen.held_out)]
        reference = Session(subject.model, threads=chosen.threads, release=True)
        try:
            fidelity = compare(reference, session, frames)
        except GraphError as error:
            return {"refused": str(error)}
        found = {each.name: each.sqnr_db for each in fidelity.outputs}
    return {
        "megabytes": graph.file_bytes(path) / 1e6,
        "int8_macs": int8 / total if total else None,
        "kernels": sum(kernels[each] for each in KERNELS),
        "sqnr_db": found,
    }


def macs_of_a_frame(model: ir.Model, nodes: Iterable[ir.Node]) -> int:
    """Add up the MACs of some nodes, but those that are computed once, at loading."""
    graph.infer_shapes(model)
    once = constant_values(model)
    return sum(graph.macs(node) or 0 for node in nodes if node.outputs[0] not in once)


def clock(chosen: argparse.Namespace) -> dict[str, tuple[float, ...]]:
    """Time one file."""
    subject = subjects.at(chosen.out)
    session = Session(
        path_of(subject, chosen.file), threads=chosen.threads, int8_kernels=True
    )
    frames = [CalibrationSet(subject.held_out)[0]]
    found = time_interleaved({chosen.file: session}, frames, RUNS)[chosen.file]
    return {"cpu_s": found.cpu_s, "wall_s": found.wall_s}


def show(rows: dict[str, Row], missing: dict[str, str]) -> None:
    plain = rows[FLOAT]
    print("\n| file | MB | int8 MACs | int8 kernels | CPU ms | x | wall ms | x |")
    print("|---|---|---|---|---|---|---|---|")
    for name, row in rows.items():
        cpu, wall = min(row.cpu_s), min(row.wall_s)
        macs = "-" if row.int8_macs is None else f"{row.int8_macs:.1%}"
        print(
            f"| {name} | {row.megabytes:.1f} | {macs} | {row.kernels}"
            f" | {cpu * 1e3:.1f} | {min(plain.cpu_s) / cpu:.2f}"
            f" | {wall * 1e3:.1f} | {min(plain.wall_s) / wall:.2f} |"
        )
    for name, reason in missing.items():
        print(f"| {name} | {reason} | | | | | | |")
    files = [name for name in rows if name != FLOAT]
    outputs = dict.fromkeys(each for name in files for each in rows[name].sqnr_db)
    print(f"\n| SQNR, dB | {' | '.join(files)} |")
    print("|---" * (len(files) + 1) + "|")
    for output in outputs:
        found = [f"{rows[name].sqnr_db[output]:.1f}" for name in files]
        print(f"| {output} | {' | '.join(found)} |")
    print(flush=True)


if __name__ == "__main__":
    main()
