"""Our plan of a BEV head beside ModelOpt's: what differs, by which rule, what it gains.

    python -m benchmarks.measure.placement OUT [--peer-python PYTHON] [--frames 4]

Every node that only one of the two reads in int8 is listed under the rule that decided
it in our plan (rule set ``tensorrt``). Then our plan is placed again with ModelOpt's
decision for the nodes of that rule alone: the difference is what the rule gains, in dB
of every output against the float graph on frames that nothing was calibrated on, and in
CPU seconds a frame (onnxruntime, TensorRT's placement, least of the rounds, in turn;
a noisy machine is noisy to all of them). Random weights: the figures say how delicate
the arithmetic is, not how accurate a trained head would be.

At the end a graph of more than 5,000 nodes is planned.
"""

import argparse
import dataclasses
import subprocess
import sys
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from time import process_time

import onnx_ir as ir

from benchmarks.subjects.subjects import Subject, make
from benchmarks.subjects.synthetic import synthetic
from benchmarks.tools.layer_timing import time_interleaved
from benchmarks.tools.processes import has_modelopt
from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import compare
from me2e_compress.graph import WEIGHTED
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.nodes import constant_values
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.quantization.decision import (
    FLOAT,
    INT8,
    Decision,
    QuantPlan,
    QuantScheme,
)
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules.rule_sets import SafeRules
from me2e_compress.runtime.session import Session
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.weights import evaluate_constants

NODES = 8000
"""As an exporter counts; more than 5,000 once constants are no nodes."""
Reads = Mapping[str, tuple[int, ...]]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--peer-python", type=Path, default=Path(sys.executable))
    parser.add_argument("--frames", type=int, default=4)
    parser.add_argument("--rounds", type=int, default=3)
    chosen = parser.parse_args()
    subject = make("bev-head", chosen.out, chosen.frames)
    peer = quantize_by_peer(subject, chosen.peer_python, chosen.frames)
    if peer is None:
        print(f"ModelOpt is not installed for {chosen.peer_python}: no comparison")
    else:
        compare_plans(subject, reads_of(graph.load(peer)), chosen.rounds)
    time_planning()


def quantize_by_peer(subject: Subject, python: Path, frames: int) -> Path | None:
    """Let ModelOpt quantize the same graph, once; None where it is not installed."""
    output = subject.folder / "modelopt.onnx"
    if output.is_file():
        return output
    if not has_modelopt(python):
        return None
    words = ["modelopt", subject.model, subject.frames, output, "--frames", frames]
    command = [
        str(python),
        "-W",
        "ignore",
        "benchmarks/tools/peer.py",
        *map(str, words),
    ]
    subprocess.run(command, check=True, capture_output=True)
    return output


def reads_of(model: ir.Model) -> Reads:
    """Map every node that reads int8 to the inputs that it reads so."""
    found: dict[str, tuple[int, ...]] = {}
    for node in model.graph:
        makers = [None if v is None else v.producer() for v in node.inputs]
        indices = tuple(
            index
            for index, made in enumerate(makers)
            if made is not None and made.op_type == "DequantizeLinear"
        )
        if indices and node.op_type not in ("QuantizeLinear", "DequantizeLinear"):
            found[node.name or ""] = indices
    return found


def compare_plans(subject: Subject, theirs: Reads, rounds: int) -> None:
    model = graph.load(subject.model)
    graph.infer_shapes(model)
    modules = ModuleMap.load(str(subject.map))
    scheme = QuantScheme.named("full", modules)
    plan = make_plan(model, scheme, SafeRules())
    differing = [
        each for each in plan.decisions if (each.dtype == INT8) != (each.node in theirs)
    ]
    print_counts(plan, theirs)
    print("\nnodes that only one of the two reads in int8, by the rule that decided:")
    for (rule, dtype, op), count in sorted(
        Counter((each.rule, each.dtype, each.op) for each in differing).items()
    ):
        print(f"  {rule:18} ours {dtype:6} {op:22} {count:4}")
    gains(subject, model, plan, differing, theirs, rounds)


def print_counts(plan: QuantPlan, theirs: Reads) -> None:
    print("operator             nodes   int8: ours  ModelOpt")
    nodes = Counter(each.op for each in plan.decisions)
    ours = Counter(each.op for each in plan.chosen)
    peers = Counter(each.op for each in plan.decisions if each.node in theirs)
    for op in sorted({*ours, *peers}):
        print(f"{op:20} {nodes[op]:5} {ours[op]:12} {peers[op]:9}")


def gains(
    subject: Subject,
    model: ir.Model,
    plan: QuantPlan,
    differing: list[Decision],
    theirs: Reads,
    rounds: int,
) -> None:
    variants = {"ours": plan}
    for rule in sorted({each.rule for each in differing}):
        nodes = {each.output for each in differing if each.rule == rule}
        variants[rule] = flipped(plan, nodes, theirs)
    nodes = {each.output for each in differing}
    variants["all of ModelOpt's"] = flipped(plan, nodes, theirs)
    names = dict.fromkeys(
        name for each in variants.values() for name in TensorRT().tensors(each, model)
    )
    fixed = constants_of(model, list(names))
    known = [name for name in names if name not in fixed]
    ranges = Calibrator(threads=2).run(model, known, CalibrationSet(subject.frames))
    ranges = dataclasses.replace(ranges, tensors={**ranges.tensors, **fixed})
    files = {
        name: write(subject, model, each, ranges) for name, each in variants.items()
    }
    report(subject, files, {n: len(v.chosen) for n, v in variants.items()}, rounds)


def constants_of(
    model: ir.Model, names: Sequence[str]
) -> dict[str, tuple[float, float]]:
    """Give the ranges of those tensors that no input changes."""
    steady = {str(value.name): value for value in constant_values(model)}
    chosen = [name for name in names if name in steady]
    computed = evaluate_constants(
        model, [name for name in chosen if steady[name].producer() is not None]
    )
    found = {}
    for name in chosen:
        array = computed.get(name)
        if array is None:
            array = graph.array_of(steady[name])
        if array is not None:
            found[name] = (float(array.min()), float(array.max()))
    return found


def flipped(plan: QuantPlan, nodes: set[str], theirs: Reads) -> QuantPlan:
    """Give our plan with the peer's decision for some nodes."""

    def flip(each: Decision) -> Decision:
        if each.output not in nodes:
            return each
        if each.dtype == INT8:
            return dataclasses.replace(
                each, dtype=FLOAT, activations=(), weight=None, axis=None
            )
        reads = theirs[each.node]
        computed = each.rule in ("weight", "attention-weights")
        if each.op in WEIGHTED and 1 in reads and not computed:
            axis = 0 if each.op == "Gemm" else len(each.shapes[1] or (0, 0)) - 1
            return dataclasses.replace(
                each, dtype=INT8, activations=(0,), weight=1, axis=axis
            )
        return dataclasses.replace(each, dtype=INT8, activations=reads)

    decisions = tuple(flip(each) for each in plan.decisions)
    return dataclasses.replace(plan, decisions=decisions)


def write(subject: Subject, model: ir.Model, plan: QuantPlan, ranges: Ranges) -> Path:
    path = subject.folder / "variant.onnx"
    count = len(list(subject.folder.glob("variant*.onnx")))
    path = path.with_name(f"variant-{count}.onnx")
    graph.save(TensorRT().place(model, plan, ranges), path)
    return path


def report(
    subject: Subject, files: Mapping[str, Path], chosen: Mapping[str, int], rounds: int
) -> None:
    held_out = CalibrationSet(subject.held_out)
    reference = Session(subject.model, threads=2, release=True)
    sessions = {
        name: Session(path, threads=2, int8_kernels=True, release=True)
        for name, path in files.items()
    }
    quality = {
        name: {e.name: e.sqnr_db for e in compare(reference, each, held_out).outputs}
        for name, each in sessions.items()
    }
    times = time_interleaved(sessions, [held_out[0]], rounds)
    ours = min(times["ours"].cpu_s)
    outputs = list(quality["ours"])
    print(
        "\nSQNR in dB; rows below the first: ModelOpt's decision for that rule alone,"
    )
    print("and in brackets what the rule gains")
    print(f"{'':20} {'int8':>5} " + " ".join(f"{n:>16}" for n in outputs) + "   CPU s")
    for name, decibels in quality.items():
        cells = [
            f"{decibels[n]:7.1f} ({quality['ours'][n] - decibels[n]:+5.1f})"
            for n in outputs
        ]
        cpu = min(times[name].cpu_s)
        print(
            f"{name:20} {chosen[name]:5} "
            + " ".join(f"{cell:>16}" for cell in cells)
            + f" {cpu:7.2f} ({cpu - ours:+.2f})"
        )


def time_planning() -> None:
    model = ir.from_proto(synthetic(NODES))
    modules = ModuleMap.whole()
    manager = PassManager(recipe.parse("import-normalize"), verify_frames=0)
    ready = manager.run(model, Context(modules)).model
    graph.infer_shapes(ready)
    start = process_time()
    plan = make_plan(ready, QuantScheme.named("feature-ext", modules), SafeRules())
    spent = process_time() - start
    counts = ", ".join(f"{rule} {count}" for rule, count in plan.counts().items())
    print(f"\n{len(plan.decisions)} nodes planned in {spent:.3f} CPU s: {counts}")


if __name__ == "__main__":
    main()
