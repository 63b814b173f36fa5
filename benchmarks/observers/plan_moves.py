"""How far the plan moves under each method and recording: question 3 of the README.

    python -m benchmarks.observers.plan_moves HELD_OUT OUT/models

The graphs are those that the studies drive.
"""

import sys
from pathlib import Path
from statistics import fmean

from benchmarks.bench_observers import METHODS
from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.fidelity.compare import Reference
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.checks import model_path

RECORDINGS = (10, 11, 12)


def main(held_out: Path, models: Path) -> None:
    reference = Reference.of(Session(model_path("highway")), CalibrationSet(held_out))
    print(f"recording | {' | '.join(METHODS)}\n---|{'---:|' * len(METHODS)}")
    rows = list[list[float]]()
    for recording in RECORDINGS:
        rows.append([])
        for method in METHODS:
            (path,) = models.glob(f"{method}-{recording}.*.onnx")
            plan = reference.compare(Session(graph.load(path))).plan
            if plan is None:
                raise SystemExit("the driver has no plan")
            rows[-1].append(plan.mean_m)
        print(_row(str(recording), rows[-1]), flush=True)
    print(_row("mean", [fmean(each) for each in zip(*rows, strict=True)]))


def _row(name: str, values: list[float]) -> str:
    return f"{name} | {' | '.join(f'{each:.3f}' for each in values)}"


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]))
