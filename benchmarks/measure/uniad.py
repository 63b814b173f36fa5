"""UniAD-tiny at its published size: export, and onnxruntime against torch.

``python -m benchmarks.measure.uniad OUT [--stack uniad-tiny] [--frames 2]
[--opset 17]``. One runtime a process, outputs passed by file. Tells CPU seconds and
peak memory of every step, the nodes of the graph, the share that the module map places
as the trace recorded, and the largest error of any output relative to its largest
value.

OUT keeps the outputs of every frame, which with ``--resume`` are not computed again: a
run that was stopped goes on, and more frames follow those that are there. The weights
must be the same. ``errors.json`` in OUT grows with every frame that both have run. The
frames are one scene, and each is fed the state of the one before.
"""

import argparse
import json
import resource
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx

from models.stacks import Stack, find

STEPS = ("export", "torch", "onnxruntime", "truth")

Outputs = dict[str, np.ndarray]


def main() -> None:
    """Run the steps one after another, each in a process of its own."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("out", type=Path)
    parser.add_argument("--stack", default="uniad-tiny")
    parser.add_argument("--frames", type=int, default=2)
    parser.add_argument("--opset", type=int, default=17)
    parser.add_argument("--plugin", action="store_true")
    parser.add_argument("--resume", action="store_true")
    parser.add_argument("--steps", default=",".join(STEPS[:3]))
    parser.add_argument("--step", choices=STEPS)
    given = parser.parse_args()
    given.out.mkdir(parents=True, exist_ok=True)
    if given.step is not None:
        _measured(lambda: RUN[given.step](given))
        return
    for step in given.steps.split(","):
        command = [sys.executable, "-m", "benchmarks.measure.uniad", *sys.argv[1:]]
        done = subprocess.run([*command, "--step", step], check=True, text=True,
                              stdout=subprocess.PIPE)  # fmt: skip
        print(f"{step}: {done.stdout.strip()}")
    if "onnxruntime" in given.steps.split(",") or given.resume:
        print(json.dumps(_noted(given.out, find(given.stack), given.frames)))


def _measured(run: Callable[[], dict[str, object]]) -> None:
    started = time.perf_counter(), time.process_time()
    found = run()
    usage = resource.getrusage(resource.RUSAGE_SELF)
    found |= {
        "wall_s": round(time.perf_counter() - started[0], 1),
        "cpu_s": round(time.process_time() - started[1], 1),
        "peak_gb": round(usage.ru_maxrss * 1024 / 1e9, 2),
    }
    print(json.dumps(found))


def _model(given: argparse.Namespace) -> Path:
    form = "plugin" if given.plugin else "standard"
    out: Path = given.out
    return out / f"{given.stack}-{given.opset}-{form}.onnx"


def _export(given: argparse.Namespace) -> dict[str, object]:
    from models.export import export

    path = _model(given)
    if given.resume and path.exists():
        return {"kept": path.name}
    export(given.stack, path, opset=given.opset, fused=given.plugin)
    graph = onnx.load(path, load_external_data=False).graph
    return {"nodes": len(graph.node), "mb": round(path.stat().st_size / 1e6, 1)}


def _frames(spec: Stack, count: int) -> list[dict[str, np.ndarray]]:
    from models.synthetic_frames import frames

    return list(frames(spec, count, 7, scene_length=count))


def _nothing(spec: Stack) -> dict[str, np.ndarray]:
    return {
        name: np.zeros(spec.inputs[name], spec.dtypes.get(name, "float32"))
        for name in spec.recurrent
    }


def _torch(given: argparse.Namespace) -> dict[str, object]:
    import torch

    from models.export import build

    spec, model = find(given.stack), build(given.stack)

    def run(feeds: Outputs) -> Outputs:
        with torch.no_grad():
            outputs = model(*(torch.from_numpy(feeds[name]) for name in spec.inputs))
        return dict(zip(spec.outputs, (x.numpy() for x in outputs), strict=True))

    state = drive(given, "torch", run)
    return {"tracks": int((state["prev_track_obj_idxes"] > 0).sum())}


def _onnxruntime(given: argparse.Namespace) -> dict[str, object]:
    from me2e_compress.runtime.session import Session

    session = Session(_model(given))
    drive(given, "onnxruntime", session.run)
    return {}


def drive(
    given: argparse.Namespace, runtime: str, run: Callable[[Outputs], Outputs]
) -> Outputs:
    """Run the frames one after another, each fed the state of the one before."""
    spec = find(given.stack)
    state = _nothing(spec)
    for index, frame in enumerate(_frames(spec, given.frames)):
        path = _saved(given.out, runtime, index)
        if given.resume and path.exists():
            with np.load(path) as kept:
                named = {name: kept[name] for name in spec.outputs}
        else:
            named = run({**frame, **state})
            _save(path, named)
        state = {name: named[answer] for name, answer in spec.recurrent.items()}
        if runtime == "onnxruntime":
            _noted(given.out, spec, index + 1)
    return state


def _saved(out: Path, runtime: str, index: int) -> Path:
    return out / f"{runtime}-{index}.npz"


def _save(path: Path, named: Mapping[str, np.ndarray]) -> None:
    """Write in one step, so that what is there is whole."""
    half = path.with_suffix(".half.npz")
    np.savez(half, allow_pickle=False, **named)
    half.rename(path)


def _noted(out: Path, spec: Stack, frames: int) -> list[dict[str, object]]:
    errors = errors_of(out, spec, frames)
    (out / "errors.json").write_text(json.dumps(errors) + "\n")
    return errors


def _truth(given: argparse.Namespace) -> dict[str, object]:
    import onnx_ir as ir

    from me2e_compress.graph.modules.assign import assign
    from me2e_compress.graph.modules.module_map import ModuleMap
    from models.tests.truth import record

    known = record(given.stack, opset=given.opset)
    graph = ir.load(_model(given))
    placed = assign(graph, ModuleMap.load("uniad"))
    hits = [
        placed.module_of(node) == known.modules[node.name or ""]
        for node in graph.graph
        if node.name in known.modules
    ]
    share = sum(hits) / len(known.modules)
    macs = {name: round(count / 1e9, 1) for name, count in known.macs.items()}
    return {"nodes": len(hits), "placed_right": round(share, 5), "gmacs": macs}


def errors_of(out: Path, spec: Stack, frames: int) -> list[dict[str, object]]:
    """Return the output that is furthest off in every frame, and by how much."""
    found = []
    for index in range(frames):
        both = [_saved(out, runtime, index) for runtime in ("torch", "onnxruntime")]
        if not all(path.exists() for path in both):
            break
        with np.load(both[0]) as want, np.load(both[1]) as got:
            errors = {}
            for name in spec.outputs:
                largest = float(np.abs(want[name]).max()) or 1.0
                errors[name] = float(np.abs(want[name] - got[name]).max()) / largest
        worst = max(errors, key=errors.__getitem__)
        found.append({"frame": index, "worst": worst, "error": errors[worst]})
    return found


RUN: dict[str, Callable[[argparse.Namespace], dict[str, object]]] = {
    "export": _export,
    "torch": _torch,
    "onnxruntime": _onnxruntime,
    "truth": _truth,
}

if __name__ == "__main__":
    main()
