"""One-pass sensitivity against one int8 node at a time.

    python -m benchmarks.bench_sensitivity OUT [--models highway,tcp,vad-tiny]
        [--frames 8] [--target tensorrt] [--nodes N] [--outputs plan,pred_wp]

For each output of each model: Spearman's rank correlation, over the nodes that the plan
makes int8, of the estimated noise with the measured one; the median of their quotient;
and the CPU time of the estimate per frame over that of inference, one thread, opening
apart. All outputs are asked for, which take turns, or those named. Measured costs stay
in OUT: a run that was stopped goes on from them. Of more nodes than ``--nodes``, evenly
spread ones are measured.
"""

import argparse
import dataclasses
import json
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from time import process_time

import numpy as np
import onnx_ir as ir
from scipy import stats

from benchmarks.subject import Subject
from benchmarks.subjects import make
from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.display import table
from me2e_compress.fidelity.compare import Reference
from me2e_compress.graph.modules import map_of
from me2e_compress.quantization.plan import FLOAT, RESIDUAL, QuantPlan, make_plan
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session, replay
from me2e_compress.sensitivity.error_sources import blamed
from me2e_compress.sensitivity.estimate import estimate
from me2e_compress.targets import TARGETS, Target


def main() -> None:
    """Estimate and measure model by model, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--models", default="highway,tcp,vad-tiny")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--target", default="tensorrt")
    parser.add_argument("--nodes", type=int, default=1000, help="most to measure")
    parser.add_argument("--outputs", default="", help="that are asked for; all")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in asked.models.split(","):
        subject = make(name, asked.out, asked.frames)
        case = Case.of(subject, asked.frames, TARGETS.parse(asked.target))
        rows += rows_of(
            case, asked.nodes, [*filter(None, asked.outputs.split(","))] or None
        )
        columns = (
            "model", "output", "nodes", "Spearman", "estimated / measured", "x time"
        )  # fmt: skip
        title = f"One-pass sensitivity, {asked.target}, {asked.frames} frames"
        print(table(title, columns, rows).markdown(), flush=True)


@dataclasses.dataclass(frozen=True)
class Case:
    """A calibrated model, and the frames that it is judged on."""

    subject: Subject
    model: ir.Model
    plan: QuantPlan
    ranges: Ranges
    target: Target
    frames: list[Frame]

    @classmethod
    def of(cls, subject: Subject, count: int, target: Target) -> "Case":
        """Plan and calibrate."""
        model = graph.load(subject.model)
        graph.infer_shapes(model)
        scheme = QuantScheme.named("full", map_of(model, str(subject.map)))
        rules = RULE_SETS.parse(DEFAULT_RULES)
        plan = make_plan(model, scheme, rules, costs=target.costs)
        plan = dataclasses.replace(plan, kept_float=target.kept_float(plan, model))
        saved, recording = (
            subject.folder / "ranges.json",
            CalibrationSet(subject.frames),
        )
        tensors = target.tensors(plan, model)
        if not saved.is_file() or {*tensors} - {*Ranges.load(saved).tensors}:
            Calibrator(threads=1).run(model, tensors, recording).save(saved)
        frames = [recording[at] for at in range(count)]
        return cls(subject, model, plan, Ranges.load(saved), target, frames)

    def alone(self, output: str) -> ir.Model:
        """Return the graph in which one node is int8, with its residual Add."""
        nodes = {str(node.outputs[0].name): node for node in self.model.graph}
        decisions = tuple(
            each
            if blamed(nodes[each.output], each) == output
            else dataclasses.replace(each, dtype=FLOAT, activations=(), weight=None)
            for each in self.plan.decisions
        )
        plan = dataclasses.replace(self.plan, decisions=decisions, groups=())
        return self.target.place(self.model, plan, self.ranges)

    def measured(self, most: int) -> Mapping[str, Mapping[str, float]]:
        """Measure the noise of nodes at each output, relative to its signal."""
        name = f"measured-{self.target.name}-{len(self.frames)}.json"
        saved = self.subject.folder / name
        found = json.loads(saved.read_text()) if saved.is_file() else {}
        reference = Reference.of(Session(self.model, threads=1), self.frames)
        layers = [each for each in self.plan.placed if each.rule != RESIDUAL]
        for each in layers[:: -(-len(layers) // most)]:
            if each.output in found:
                continue
            session = Session(self.alone(each.output), threads=1)
            outputs = reference.compare(session).outputs
            found[each.output] = {e.name: 10 ** (-e.sqnr_db / 20) for e in outputs}
            write_json(saved, found)
        return found


def rows_of(case: Case, most: int, outputs: list[str] | None) -> list[tuple[str, ...]]:
    """Return a row for each output."""
    grids = case.target.grids(case.plan, case.model, case.ranges)
    told = partial(estimate, case.model, case.plan, grids, threads=1, outputs=outputs)
    found = {e.output: e.noise for e in told(case.frames) if e.noise is not None}
    ratio = per_frame_s(case, told) / per_frame_s(case, partial(_infer, case.model))
    measured, rows = case.measured(most), list[tuple[str, ...]]()
    for output in next(iter(found.values()), {}):
        names = [name for name in found if measured.get(name, {}).get(output)]
        ours = np.array([found[name][output] for name in names])
        theirs = np.array([measured[name][output] for name in names])
        rank = float(stats.spearmanr(ours, theirs).statistic)
        quotient = float(np.median(ours / theirs))
        counted = f"{len(names)} of {len(measured)}"
        rows.append(
            (case.subject.name, output, counted, f"{rank:.3f}", f"{quotient:.2f}",
             f"{ratio:.2f}")
        )  # fmt: skip
    return rows


def _infer(model: ir.Model, frames: list[Frame]) -> None:
    for _ in replay(Session(model, threads=1), frames):
        pass


def per_frame_s(case: Case, run: Callable[[list[Frame]], object]) -> float:
    """Return CPU seconds of one more frame, so without those of opening.

    No fewer frames than outputs, which take turns, are run at least.
    """
    seconds = []
    for frames in (case.frames, case.frames * 4):
        start = process_time()
        run(frames)
        seconds.append(process_time() - start)
    return (seconds[1] - seconds[0]) / (3 * len(case.frames))


if __name__ == "__main__":
    main()
