"""How far the plan moves under each method and recording: question 3 of the README.

    PYTHONPATH=CHECKOUT python benchmarks/observers/plan_moves.py FOLDER [MODELS]

FOLDER has the recordings and the held-out frames. The graphs are those of the fifteen
drives, made by the ``me2e_compress`` that Python finds, so that an earlier commit can
make them; MODELS, where the study kept its own, are held against them.
"""

import dataclasses
import sys
from pathlib import Path

from me2e_compress import graph
from me2e_compress.calibration.calibrator import Calibrator
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.calibration.observers import OBSERVERS
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.fidelity.compare import Reference
from me2e_compress.passes import PASSES
from me2e_compress.passes.base import Context
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.checks import model_path
from me2e_compress.workflows.prepare_int8 import PreparedGraph

METHODS = ("max-min", "moving-average", "percentile", "mse", "entropy")
BEFORE = (
    *("import-normalize", "fold-constants", "eliminate-redundant"),
    *("hoist-linear", "fuse-basic"),
)
STEP = QuantizeInt8(scheme="full", rules="safe")


def main(folder: Path, models: Path | None) -> None:
    path = model_path("highway")
    passes = [PASSES.parse(name) for name in BEFORE]
    ready = PreparedGraph.of(path, graph.load(path), None, [*passes, STEP])
    tensors = STEP.ranged_tensors(ready.model, Context(ready.modules))
    reference = Reference.of(Session(path), CalibrationSet(folder / "held-out"))
    print(f"recording | {' | '.join(METHODS)}\n---|{'---:|' * len(METHODS)}")
    for seed in (10, 11, 12):
        frames = CalibrationSet(folder / f"frames-{seed}")
        seen = Calibrator("mse").collect(ready.model, tensors, frames)
        moved = []
        for method in METHODS:
            known = {STEP.name: Ranges.of(seen, OBSERVERS.parse(method))}
            context = Context(ready.modules, frames, measured=known)
            step = dataclasses.replace(STEP, method=method)
            made = step.run(ready.model.clone(), context).model
            plan = reference.compare(Session(made)).plan
            if plan is None:
                raise SystemExit("the driver has no plan")
            moved.append(plan.mean_m)
            for kept in (
                () if models is None else models.glob(f"{method}-{seed}.*.onnx")
            ):
                same = graph.digest(made) == graph.digest(graph.load(kept))
                print(f"{kept.name}: {'the same' if same else 'ANOTHER'} graph")
        print(f"{seed} | {' | '.join(f'{each:.3f}' for each in moved)}", flush=True)


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]) if len(sys.argv) > 2 else None)
