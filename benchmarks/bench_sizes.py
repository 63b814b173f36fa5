"""File sizes of VAD-tiny in int8, beside the paper's Table 4.

    python -m benchmarks.bench_sizes OUT [--model MODEL.onnx]

The graph after the exact passes: three schemes, two rule sets, both targets.
How many bytes a scale takes does not depend on its value, so nothing is calibrated:
every activation gets the range [-1, 1]. The files are for weighing alone, and are
removed. The paper's export is another: sizes are compared as parts of the float file.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path

import onnx_ir as ir

from benchmarks import subjects
from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.modules import ModuleMap
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets import TARGETS

PAPER_MB = {"prediction": 104.57, "feature-ext": 119.25, "full": 83.32}
"""Table 4: after quantization; 140.50 MB before."""
PAPER_FLOAT_MB = 140.50


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--model", type=Path, help="after the exact passes")
    options = parser.parse_args(argv)
    path = options.model or subjects.make("vad-tiny", options.out, 1).model
    model = graph.load(path)
    graph.infer_shapes(model)
    whole = graph.file_bytes(path) / 1e6
    print(f"float: {whole:.1f} MB; the paper's: {PAPER_FLOAT_MB:.1f} MB\n")
    print("| scheme | rules | target | MB | of float | int8 MB | paper MB | of float |")
    print("|---|---|---|---|---|---|---|---|")
    options.out.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryDirectory(dir=options.out) as folder:
        for scheme in PAPER_MB:
            for rules in ("safe", "paper"):
                for target in TARGETS.names():
                    made = placed(model, scheme, rules, target)
                    saved = Path(folder) / "placed.onnx"
                    graph.save(made, saved)
                    show(scheme, rules, target, made, saved, whole)


def placed(model: ir.Model, scheme: str, rules: str, target: str) -> ir.Model:
    """Make one variant, every range [-1, 1]."""
    chosen = QuantScheme.named(scheme, ModuleMap.load("vad"))
    costs = TARGETS.parse(target).costs
    plan = make_plan(model, chosen, RULE_SETS.parse(rules), costs=costs)
    names = TARGETS.parse(target).tensors(plan, model)
    ranges = Ranges(dict.fromkeys(names, (-1.0, 1.0)), "none", 0, "", "")
    return TARGETS.parse(target).place(model, plan, ranges)


def show(
    scheme: str, rules: str, target: str, made: ir.Model, path: Path, whole: float
) -> None:
    weights = (value.const_value for value in made.graph.initializers.values())
    int8 = sum(w.nbytes for w in weights if w is not None and w.dtype.name == "INT8")
    size, theirs = graph.file_bytes(path) / 1e6, PAPER_MB[scheme]
    print(
        f"| {scheme} | {rules} | {target} | {size:.1f} | {size / whole:.0%}"
        f" | {int8 / 1e6:.1f} | {theirs:.2f} | {theirs / PAPER_FLOAT_MB:.0%} |",
        flush=True,
    )


if __name__ == "__main__":
    main()
