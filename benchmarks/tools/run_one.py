"""Run one frame of a model in one runtime, in an interpreter of its own.

    python benchmarks/tools/run_one.py ENGINE MODEL.onnx FRAME.npz OUT.npz [--threads 2]
        [--runs 3]

It needs none of this package for the engines of others, so that one may live in an
environment of its own. Prints one line of JSON: seconds of CPU and of the clock of
every run after one that is not counted, seconds of CPU until then, and the largest
resident set in MB; OUT.npz gets the outputs of the last.

Engines: ``onnxruntime`` (defaults), ``ours`` (a Session of this package: the same
onnxruntime, with the kernels of fused nodes), ``openvino-f32``, ``openvino-bf16``, and
``torch``, ``torch-compile``, where MODEL.onnx is the name of a stack of models/ or
``vad-tiny-original``.
"""

import argparse
import functools
import importlib
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np

Run = Callable[[], Mapping[str, Any]]
"""Runs one frame and gives its outputs by name."""


def torch_eager(
    stack: str, frame: Mapping[str, Any], threads: int, *, compiled: bool = False
) -> Run:
    """Build a stack, as its export is built: from seed 0."""
    import torch

    from benchmarks.subjects import original_patterns
    from models.export import build
    from models.stacks import find

    torch.set_num_threads(threads)
    originally = stack == original_patterns.NAME
    spec = find(original_patterns.OF if originally else stack)
    model = original_patterns.original() if originally else build(stack)
    inputs = [torch.from_numpy(frame[name]) for name in spec.inputs]
    called: Callable[..., Any] = torch.compile(model) if compiled else model

    def run() -> Mapping[str, Any]:
        with torch.no_grad():
            values = called(*inputs)
        return {
            name: value.numpy()
            for name, value in zip(spec.outputs, values, strict=True)
        }

    return run


def plain_onnxruntime(path: str, frame: Mapping[str, Any], threads: int) -> Run:
    """Open a file in onnxruntime as its documentation does, but for the threads."""
    import onnxruntime

    onnxruntime.disable_telemetry_events()
    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    # Threads that spin while they wait would count as CPU time.
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    session = onnxruntime.InferenceSession(
        path, options, providers=["CPUExecutionProvider"]
    )
    names = [each.name for each in session.get_outputs()]
    fed = {each.name: frame[each.name] for each in session.get_inputs()}
    return lambda: dict(zip(names, session.run(names, fed), strict=True))


def our_session(path: str, frame: Mapping[str, Any], threads: int) -> Run:
    """Open a file as every command of this package does."""
    from me2e_compress.runtime.session import Session

    session = Session(Path(path), threads=threads, int8_kernels=True)
    fed = {name: frame[name] for name in session.inputs}
    return lambda: session.run(fed)


def openvino(
    path: str, frame: Mapping[str, Any], threads: int, *, precision: str
) -> Run:
    """Compile a file for OpenVINO's CPU plugin."""
    core = importlib.import_module("openvino").Core()
    compiled = core.compile_model(
        core.read_model(path),
        "CPU",
        {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": precision},
    )
    fed = {each.any_name: frame[each.any_name] for each in compiled.inputs}
    request = compiled.create_infer_request()

    def run() -> Mapping[str, Any]:
        found = request.infer(fed)
        # One port may stand for several outputs, and have the names of all
        return {name: found[port] for port in compiled.outputs for name in port.names}

    return run


ENGINES: Mapping[str, Callable[[str, Mapping[str, Any], int], Run]] = {
    "torch": torch_eager,
    "torch-compile": functools.partial(torch_eager, compiled=True),
    "onnxruntime": plain_onnxruntime,
    "ours": our_session,
    "openvino-f32": functools.partial(openvino, precision="f32"),
    "openvino-bf16": functools.partial(openvino, precision="bf16"),
}


def timed(run: Run, runs: int) -> tuple[dict[str, list[float]], Mapping[str, Any]]:
    """Time a few runs, after one that is not counted."""
    outputs = run()
    taken: dict[str, list[float]] = {"cpu_s": [], "wall_s": []}
    for _ in range(runs):
        cpu, wall = time.process_time(), time.perf_counter()
        outputs = run()
        taken["cpu_s"].append(time.process_time() - cpu)
        taken["wall_s"].append(time.perf_counter() - wall)
    return taken, outputs


def peak_mb() -> float:
    """Return the largest resident set of this process, MB; Linux.

    Not getrusage: there a process inherits the peak of the one that started it.
    """
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    (line,) = (each for each in status.splitlines() if each.startswith("VmHWM"))
    return int(line.split()[1]) / 1024


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("engine", choices=ENGINES)
    parser.add_argument("model")
    parser.add_argument("frame", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    with np.load(given.frame) as held:
        frame = dict(held)
    run = ENGINES[given.engine](given.model, frame, given.threads)
    taken, outputs = timed(run, given.runs)
    arrays: dict[str, Any] = {name: np.asarray(each) for name, each in outputs.items()}
    np.savez(given.out, **arrays)
    print(json.dumps({**taken, "peak_mb": peak_mb()}))


if __name__ == "__main__":
    main()
