"""The paper's table 4, of UniAD-tiny and VAD-tiny: what of each file becomes int8.

    python -m benchmarks.measure.table_4 OUT
    python -m benchmarks.measure.table_4 OUT --stacks vad-tiny --rules safe,paper --lint

Exports each stack into OUT unless it is there, runs the exact passes, and places int8
for TensorRT by each scheme. How much becomes int8, and how large the file gets, does
not depend on what a scale's value is: nothing is calibrated, and every activation gets
the range [-1, 1]. ``--lint`` also looks for what TensorRT would refuse; ``--trt-check``
parses each file by TensorRT-RTX, if that is installed. The files stay in OUT/STACK, so
that ``benchmarks.paper --stack OUT/STACK`` can read them (of the last rules).
"""

import argparse
import dataclasses
import sys
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path

import onnx_ir as ir

from benchmarks.paper.published import INT8_COUNTS
from benchmarks.paper.weigh import int8_counts
from benchmarks.subjects.subjects import write_source
from me2e_compress import graph
from me2e_compress.base.errors import Me2eError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.commands.compress import compress
from me2e_compress.commands.lint import lint
from me2e_compress.commands.options import CompressOptions, LintOptions
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.quantization.decision import QuantScheme, stamp_plan
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets import TARGETS

PRESETS = {"uniad-tiny": "uniad", "vad-tiny": "vad"}
PAPER = {"uniad-tiny": "UniAD", "vad-tiny": "VAD"}
SCHEMES = ("prediction", "feature-ext", "full")
HEAD = """\
| stack | scheme | rules | tensors | paper's | int8 operators | paper's \
| compute-intensive | paper's | MB | paper's | M weights in int8 | by the paper's MB |
|---|---|---|---:|---:|---:|---:|---:|---:|---:|---:|---:|---:|"""


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path)
    parser.add_argument("--stacks", default=",".join(PRESETS))
    parser.add_argument("--rules", default="safe,paper")
    parser.add_argument("--lint", action="store_true")
    parser.add_argument("--trt-check", action="store_true")
    given = parser.parse_args(argv)
    print(HEAD, flush=True)
    more: list[str] = []
    try:
        for name in given.stacks.split(","):
            folder = given.out / name
            exact = prepared(name, given.out)
            print(float_row(name, exact), flush=True)
            for rules in given.rules.split(","):
                for scheme in SCHEMES:
                    path = folder / f"{scheme}.onnx"
                    model = place(exact, path, scheme, rules, PRESETS[name])
                    print(row(name, exact, path, scheme, rules, model), flush=True)
                    more += modules(name, scheme, rules, model)
                    if given.lint or given.trt_check:
                        more += checked(path, name, scheme, rules, given.trt_check)
    except Me2eError as error:
        sys.exit(f"table_4: {error}")
    print("", *more, sep="\n")


def prepared(name: str, out: Path) -> Path:
    """Export a stack and run the exact passes, unless that is done.

    Raises:
        Me2eError: one of them fails.
    """
    source, exact = out / f"{name}.onnx", out / name / "exact.onnx"
    exact.parent.mkdir(parents=True, exist_ok=True)
    if not source.is_file():
        write_source(name, source)
    if not exact.is_file():
        unchecked = CompressOptions(module_map=PRESETS[name], verify_frames=0)
        compress(source, exact, "exact", options=unchecked)
    return exact


def place(exact: Path, path: Path, scheme: str, rules: str, preset: str) -> ir.Model:
    """Write what a scheme makes of a file, every range [-1, 1]; return the graph."""
    model = graph.load(exact)
    graph.infer_shapes(model)
    target = TARGETS.parse("tensorrt")
    plan = make_plan(
        model,
        QuantScheme.named(scheme, ModuleMap.load(preset)),
        RULE_SETS.parse(rules),
        costs=target.costs,
        fused=target.fused_objection,
    )
    kept = target.kept_float(plan, model)
    plan = dataclasses.replace(plan, kept_float=kept)
    names = target.tensors(plan, model)
    ranges = Ranges(dict.fromkeys(names, (-1.0, 1.0)), "none", 0, "", "")
    placed = target.place(model, plan, ranges)
    stamp_plan(placed, plan)
    graph.save(placed, path)
    return placed


def float_row(name: str, exact: Path) -> str:
    size, given = graph.file_bytes(exact) / 1e6, INT8_COUNTS[PAPER[name], "exact"]
    cells = (name, "float", *[""] * 7, f"{size:.2f}", f"{given.megabytes:.2f}", "", "")
    return f"| {' | '.join(cells)} |"


def row(
    name: str, exact: Path, path: Path, scheme: str, rules: str, model: ir.Model
) -> str:
    """Count what of a file is int8, the paper's counts beside each.

    Raises:
        Me2eError: the file carries no plan.
    """
    found, given = int8_counts(path), INT8_COUNTS[PAPER[name], scheme]
    if found is None:
        raise Me2eError(f"{path} carries no plan")
    whole = INT8_COUNTS[PAPER[name], "exact"].megabytes
    cells = (
        *(name, scheme, rules),
        *(str(found.tensors), str(given.tensors)),
        *(str(found.operators), str(given.operators)),
        *(str(found.compute_intensive), str(given.compute_intensive)),
        *(f"{graph.file_bytes(path) / 1e6:.2f}", f"{given.megabytes:.2f}"),
        f"{sum(weights(model).values()) / 1e6:.2f}",
        f"{(whole - given.megabytes) / 3:.2f}",  # a float weight is 3 bytes longer
    )
    return f"| {' | '.join(cells)} |"


def weights(model: ir.Model) -> Counter[str]:
    """Count the elements of int8 weights by module."""
    found = Counter[str]()
    for value in model.graph.initializers.values():
        held, readers = value.const_value, value.consumers()
        if held is None or held.dtype != ir.DataType.INT8 or len(held.shape) < 2:
            continue
        found[provenance.module_of(readers[0])] += held.size
    return found


def modules(name: str, scheme: str, rules: str, model: ir.Model) -> Iterator[str]:
    """Say in which modules the int8 weights are."""
    parts = [f"{each} {count / 1e6:.2f}" for each, count in weights(model).items()]
    yield f"{name} {scheme} ({rules}), M weights in int8: {', '.join(parts)}"


def checked(
    path: Path, name: str, scheme: str, rules: str, parse: bool
) -> Iterator[str]:
    """Say what the lint for the paper's TensorRT and, if asked, TensorRT-RTX say."""
    found = lint(path, LintOptions(trt_check=parse, target_version="10.7"))
    yield f"{name} {scheme} ({rules}): {'; '.join(found.lines())}"


if __name__ == "__main__":
    main()
