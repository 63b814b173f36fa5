"""Run frames of a model in one runtime, in an interpreter of its own.

    python benchmarks/tools/run_one.py ENGINE MODEL FRAMES/ [--out OUT.npz]
        [--threads 2] [--runs 3]

It needs none of this package for the engines of others, so that one may live in an
environment of its own. Prints one line of JSON: seconds of CPU and of the clock of
every run of the first frame after one that is not counted, and the largest resident
set in MB; OUT.npz gets the outputs of all frames, each [frames, ...].

Engines: ``onnxruntime`` (defaults), ``ours`` (a Session of this package: the same
onnxruntime, with the kernels of fused nodes), ``ours-openvino`` (a Session whose
provider is OpenVINO), ``openvino-f32``, ``openvino-bf16``, and ``torch``,
``torch-compile``, where MODEL is the name of a stack of models/ or
``vad-tiny-original``.
"""

import argparse
import functools
import importlib
import json
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

Frame = Mapping[str, Any]
Run = Callable[[Frame], Mapping[str, Any]]
"""Runs one frame and gives its outputs by name."""


def torch_eager(stack: str, threads: int, *, compiled: bool = False) -> Run:
    """Build a stack, as its export is built: from seed 0."""
    import torch

    from benchmarks.subjects import original_patterns
    from models.export import build
    from models.stacks import find

    torch.set_num_threads(threads)
    originally = stack == original_patterns.NAME
    spec = find(original_patterns.OF if originally else stack)
    model = original_patterns.original() if originally else build(stack)
    called: Callable[..., Any] = torch.compile(model) if compiled else model

    def run(frame: Frame) -> Mapping[str, Any]:
        inputs = [torch.from_numpy(frame[name]) for name in spec.inputs]
        with torch.no_grad():
            values = called(*inputs)
        return {
            name: value.numpy()
            for name, value in zip(spec.outputs, values, strict=True)
        }

    return run


def plain_onnxruntime(path: str, threads: int) -> Run:
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
    outputs = [each.name for each in session.get_outputs()]
    inputs = [each.name for each in session.get_inputs()]

    def run(frame: Frame) -> Mapping[str, Any]:
        found = session.run(outputs, {name: frame[name] for name in inputs})
        return dict(zip(outputs, found, strict=True))

    return run


def our_session(path: str, threads: int, *, provider: str = "cpu") -> Run:
    """Open a file as every command of this package does."""
    from me2e_compress.runtime.providers import provider_named
    from me2e_compress.runtime.session import Session

    session = Session(
        Path(path),
        threads=threads,
        int8_kernels=True,
        provider=provider_named(provider),
    )
    return lambda frame: session.run({name: frame[name] for name in session.inputs})


def openvino(path: str, threads: int, *, precision: str) -> Run:
    """Compile a file for OpenVINO's CPU plugin.

    A port has the names of all values that it stands for, and answers to any of them.
    """
    core = importlib.import_module("openvino").Core()
    compiled = core.compile_model(
        core.read_model(path),
        "CPU",
        {"INFERENCE_NUM_THREADS": threads, "INFERENCE_PRECISION_HINT": precision},
    )
    request = compiled.create_infer_request()

    def run(frame: Frame) -> Mapping[str, Any]:
        inputs = {
            at: frame[next(name for name in sorted(port.names) if name in frame)]
            for at, port in enumerate(compiled.inputs)
        }
        # `infer` hides on one thread that a node failed (2026.4.1)
        request.start_async(inputs)
        request.wait()
        return {
            name: request.get_output_tensor(at).data.copy()
            for at, port in enumerate(compiled.outputs)
            for name in port.names
        }

    return run


ENGINES: Mapping[str, Callable[[str, int], Run]] = {
    "torch": torch_eager,
    "torch-compile": functools.partial(torch_eager, compiled=True),
    "onnxruntime": plain_onnxruntime,
    "ours": our_session,
    "ours-openvino": functools.partial(our_session, provider="openvino"),
    "openvino-f32": functools.partial(openvino, precision="f32"),
    "openvino-bf16": functools.partial(openvino, precision="bf16"),
}


def timed(run: Run, frame: Frame, runs: int) -> dict[str, list[float]]:
    """Time a few runs, after one that is not counted."""
    run(frame)
    taken: dict[str, list[float]] = {"cpu_s": [], "wall_s": []}
    for _ in range(runs):
        cpu, wall = time.process_time(), time.perf_counter()
        run(frame)
        taken["cpu_s"].append(time.process_time() - cpu)
        taken["wall_s"].append(time.perf_counter() - wall)
    return taken


def all_outputs(run: Run, frames: Sequence[Frame]) -> dict[str, Any]:
    """Return the outputs of all frames, one behind the other."""
    answers = [
        {name: np.array(value) for name, value in run(frame).items()}
        for frame in frames
    ]
    return {name: np.stack([each[name] for each in answers]) for name in answers[0]}


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
    parser.add_argument("frames", type=Path)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--runs", type=int, default=3)
    given = parser.parse_args()
    frames = [dict(np.load(path)) for path in sorted(given.frames.glob("*.npz"))]
    run = ENGINES[given.engine](given.model, given.threads)
    taken, peak = timed(run, frames[0], given.runs), peak_mb()
    if given.out is not None:
        np.savez(given.out, **all_outputs(run, frames))
    print(json.dumps({**taken, "peak_mb": peak}))


if __name__ == "__main__":
    main()
