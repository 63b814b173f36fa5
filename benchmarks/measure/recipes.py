"""What every shipped recipe makes of VAD-tiny: size, fidelity, and does it still see.

    python -m benchmarks.measure.recipes [FOLDER] [--only full,fused]

Exports VAD-tiny and writes its frames into FOLDER (default: a scratch folder), runs
every recipe for it from file to file, and compares each result with the source on
frames of another seed; how far the plan moves over these is printed as a share of the
source's. Random weights: figures say how numerically delicate the graph is, not how
well a trained one would drive.
"""

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from time import process_time

from benchmarks.subjects.tensorrt_recipe import for_tensorrt
from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.commands.compress import compress
from me2e_compress.commands.options import CompressOptions
from me2e_compress.fidelity.compare import Reference
from me2e_compress.fidelity.liveness import LivenessTally
from me2e_compress.manager import recipe
from me2e_compress.runtime.session import Session
from models.export import export
from models.frames import record

STACK, PLAN = "vad-tiny", "ego_fut_preds"
OF_OTHERS = ("minus-", "uniad-")
"""These take modules from the driver highway and from UniAD."""
RECIPES = [name for name in recipe.shipped() if not name.startswith(OF_OTHERS)]
HEAD = "recipe            MB   nodes  int8 MB  ego dB  plan m (max)  plan moves  CPU s"


def main(argv: Sequence[str] | None = None) -> None:
    parser = argparse.ArgumentParser()
    parser.add_argument("folder", type=Path, nargs="?")
    parser.add_argument("--only", default=",".join(["source", *RECIPES]))
    options = parser.parse_args(argv)
    with tempfile.TemporaryDirectory() as scratch:
        folder = options.folder or Path(scratch)
        folder.mkdir(parents=True, exist_ok=True)
        source = export(STACK, folder / f"{STACK}.onnx")
        seen, held_out = (
            record(STACK, folder / name, count, seed=seed, scene_length=length)
            for name, count, seed, length in (
                ("frames", 8, 0, 4),
                ("held-out", 4, 1, 1),
            )
        )
        others = CalibrationSet(held_out)
        print(HEAD, flush=True)
        opened = Session(source, threads=2, release=True)
        reference = Reference.of(opened, others)
        for name in options.only.split(","):
            if name == "source":
                report(name, source, reference, 0.0)
                continue
            start = process_time()
            target = folder / f"{name}.onnx"
            unchecked = CompressOptions(
                module_map="vad", verify_frames=0, measure_frames=0
            )
            compress(source, target, for_tensorrt(name), seen, unchecked)
            report(name, target, reference, process_time() - start)


def report(name: str, path: Path, reference: Reference, cpu_s: float) -> None:
    model = graph.load(path)
    weights = [value.const_value for value in model.graph.initializers.values()]
    int8 = sum(w.nbytes for w in weights if w is not None and w.dtype.name == "INT8")
    session = Session(path, threads=2, int8_kernels=True, release=True)
    tally = LivenessTally(reference.session, session)
    found = reference.compare(session, watchers=[tally.add])
    ego = {item.name: item.sqnr_db for item in found.outputs}[PLAN]
    (alive,) = (each for each in tally.result().outputs if each.output == PLAN)
    plan = found.plan
    metres = "-" if plan is None else f"{plan.mean_m:.3f} ({plan.max_m:.3f})"
    print(
        f"{name:15} {path.stat().st_size / 1e6:6.1f} {graph.node_count(model):6}"
        f" {int8 / 1e6:8.1f} {ego:7.1f}  {metres:15} {alive.moves or 0.0:11.1%}"
        f" {cpu_s:7.1f}",
        flush=True,
    )


if __name__ == "__main__":
    main()
