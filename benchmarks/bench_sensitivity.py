"""One-pass sensitivity against one int8 node at a time.

    python -m benchmarks.bench_sensitivity OUT [--models highway,tcp,vad-tiny]
        [--frames 8] [--target tensorrt] [--nodes N] [--outputs ego_fut_preds]
        [--alone plan,pred_wp] [--held GB]

For each output of each model: Spearman's rank correlation, over the nodes that the plan
makes int8, of the estimated noise with the measured one; the median of their quotient;
and the CPU time of a run of the estimate over that of inference on the same frames, the
median of each, one thread, opening apart. All outputs, or those named, take turns;
those of ``--alone`` are asked for alone as well. Measured costs stay in OUT: a run that
was stopped goes on from them. Of more estimated nodes than ``--nodes``, evenly spread
ones are measured.
"""

import argparse
import dataclasses
import json
from collections.abc import Iterator, Mapping, Sequence
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
from me2e_compress.quantization.plan import FLOAT, QuantPlan, make_plan
from me2e_compress.quantization.rules import DEFAULT_RULES, RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.atomic import write_json
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.session import Session, replay
from me2e_compress.sensitivity.error_sources import blamed
from me2e_compress.sensitivity.estimate import MOST_HELD, NodeCost, estimate
from me2e_compress.targets import TARGETS, Target


def main() -> None:
    """Estimate and measure model by model, and print one table."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--models", default="highway,tcp,vad-tiny")
    parser.add_argument("--frames", type=int, default=8)
    parser.add_argument("--target", default="tensorrt")
    parser.add_argument("--nodes", type=int, default=1000, help="most to measure")
    parser.add_argument("--outputs", default="", help="that take turns; all")
    parser.add_argument("--alone", default="plan,pred_wp")
    parser.add_argument("--held", type=float, default=MOST_HELD / 1e9, help="GB")
    asked = parser.parse_args()
    asked.out.mkdir(parents=True, exist_ok=True)
    rows = []
    for name in asked.models.split(","):
        subject = make(name, asked.out, asked.frames)
        case = Case.of(subject, asked.frames, TARGETS.parse(asked.target))
        outputs = [*filter(None, asked.outputs.split(","))] or None
        alone, held = asked.alone.split(","), round(asked.held * 1e9)
        rows += rows_of(case, asked.nodes, outputs, alone, held)
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

    def measured(
        self, names: Sequence[str], most: int
    ) -> Mapping[str, Mapping[str, float]]:
        """Measure the noise of nodes at each output, relative to its signal."""
        name = f"measured-{self.target.name}-{len(self.frames)}.json"
        saved = self.subject.folder / name
        found = json.loads(saved.read_text()) if saved.is_file() else {}
        chosen = names[:: -(-len(names) // most)]
        if left := [output for output in chosen if output not in found]:
            reference = Reference.of(Session(self.model, threads=1), self.frames)
            for output in left:
                session = Session(self.alone(output), threads=1)
                told = reference.compare(session).outputs
                found[output] = {each.name: 10 ** (-each.sqnr_db / 20) for each in told}
                write_json(saved, found)
        return {name: found[name] for name in chosen}


class Timed:
    """Frames that note the CPU seconds from each to the next."""

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self.seconds = list[float]()

    def __len__(self) -> int:
        return len(self._frames)

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._frames:
            start = process_time()
            yield frame
            self.seconds.append(process_time() - start)


def rows_of(
    case: Case, most: int, asked: list[str] | None, alone: list[str], held: int
) -> list[tuple[str, ...]]:
    """Return a row for each output, and one for those that are asked for alone."""
    grids = case.target.grids(case.plan, case.model, case.ranges)
    told = partial(estimate, case.model, case.plan, grids, threads=1, most_held=held)
    # inference before and after: the machine is not alone either
    first, frames, last = (Timed(case.frames) for _ in range(3))
    infer(case.model, first)
    found = noise_of(told(frames, outputs=asked))
    infer(case.model, last)
    ratio = np.median(frames.seconds) / np.median(first.seconds + last.seconds)
    measured = case.measured([*found], most)
    outputs = [*next(iter(found.values()), {})]
    rows: list[tuple[str, ...]] = [
        (case.subject.name, name, *compared(found, measured, name), f"{ratio:.2f}")
        for name in outputs
    ]
    for name in filter(outputs.__contains__, alone):
        only = noise_of(told(case.frames, outputs=[name]))
        row = compared(only, measured, name)
        rows.append((case.subject.name, f"{name}, alone", *row, ""))
    return rows


def noise_of(costs: Sequence[NodeCost]) -> dict[str, Mapping[str, float]]:
    """Return what is estimated of each node."""
    return {each.output: each.noise for each in costs if each.noise is not None}


def compared(
    found: Mapping[str, Mapping[str, float]],
    measured: Mapping[str, Mapping[str, float]],
    output: str,
) -> tuple[str, str, str]:
    """Count the nodes that move an output; compare what is said of them."""
    names = [name for name in found if measured.get(name, {}).get(output)]
    ours = np.array([found[name][output] for name in names])
    theirs = np.array([measured[name][output] for name in names])
    rank = float(stats.spearmanr(ours, theirs).statistic)
    quotient = float(np.median(ours / theirs))
    return f"{len(names)} of {len(measured)}", f"{rank:.3f}", f"{quotient:.2f}"


def infer(model: ir.Model, frames: Frames) -> None:
    """Run the float graph."""
    for _ in replay(Session(model, threads=1), frames):
        pass


if __name__ == "__main__":
    main()
