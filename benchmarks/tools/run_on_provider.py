"""Run one frame of a file on one provider of onnxruntime, in a process of its own.

    python -m benchmarks.tools.run_on_provider MODEL.onnx FRAME.npz OUT.npz
        --provider TEXT [--stock] [--bound] [--threads 0] [--warm-up 20] [--runs 200]
        [--seconds 60] [--energy]

Prints one line of JSON: seconds on the clock of every run after the warm-up (until so
many runs or seconds, but five at least), the device's memory that was taken meanwhile,
the largest resident set, with ``--energy`` joules a frame. OUT.npz gets the outputs.

``--stock`` makes every optimization of onnxruntime, those that our sessions leave out
too. ``--bound`` leaves inputs and outputs on the device: what is copied for every frame
otherwise is the difference.
"""

import argparse
import dataclasses
import json
import sys
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import onnxruntime as ort
import pynvml

from benchmarks.tools.run_one import peak_mb
from me2e_compress.base.errors import EnergyError, Me2eError
from me2e_compress.base.text import name_in
from me2e_compress.runtime.energy import EnergyResult
from me2e_compress.runtime.energy.energy_counter import (
    ENERGY_COUNTERS,
    EnergySchedule,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import Absent, Reader
from me2e_compress.runtime.energy.meter import EnergyMeter
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.providers import CPU, Provider, provider_named
from me2e_compress.runtime.session import Session

FEWEST_RUNS = 5
SCHEDULE = EnergySchedule(warm_up_s=10, windows=5)
"""A minute and a half a row, where a counter answers."""
Run = Callable[[], object]
Outputs = Callable[[], Mapping[str, Any]]


def our_session(
    path: Path, feeds: Mapping[str, Array], provider: Provider, given: Any
) -> tuple[Run, Outputs]:
    """Open a file as every command does; return what runs it, and its outputs."""
    session = Session(
        path,
        threads=given.threads,
        provider=provider,
        stock=given.stock,
        int8_kernels=True,
    )
    fed = {name: feeds[name] for name in session.inputs}
    return lambda: session.run(fed), lambda: session.run(fed)


def bound_session(
    path: Path, feeds: Mapping[str, Array], provider: Provider, given: Any
) -> tuple[Run, Outputs]:
    """Open a file with its inputs and outputs in the memory of the device."""
    options = ort.SessionOptions()
    options.intra_op_num_threads = given.threads
    options.log_severity_level = 4
    options.add_session_config_entry("session.intra_op.allow_spinning", "0")
    provider.attach(options)
    session = ort.InferenceSession(
        str(path),
        options,
        providers=provider.chain(),
        disabled_optimizers=list(provider.left_out),
        enable_fallback=False,
    )
    provider.confirm(session.get_providers())
    place = "cpu" if provider.native == CPU.native else "cuda"
    binding = session.io_binding()
    for port in session.get_inputs():
        value = ort.OrtValue.ortvalue_from_numpy(feeds[port.name], place)
        binding.bind_ortvalue_input(port.name, value)
    names = [port.name for port in session.get_outputs()]
    for name in names:
        binding.bind_output(name, place)

    def run() -> None:
        session.run_with_iobinding(binding)
        binding.synchronize_outputs()

    def outputs() -> Mapping[str, Any]:
        run()
        return dict(zip(names, binding.copy_outputs_to_cpu(), strict=True))

    return run, outputs


def timed(run: Run, warm_up: int, runs: int, seconds: float) -> list[float]:
    """Time runs, after some that are not counted."""
    for _ in range(warm_up):
        run()
    taken: list[float] = []
    while len(taken) < FEWEST_RUNS or (len(taken) < runs and sum(taken) < seconds):
        begun = time.perf_counter()
        run()
        taken.append(time.perf_counter() - begun)
    return taken


def gpu_used_mb(device: int) -> float | None:
    """Return the memory in use on a GPU, whoever uses it; None where NVML is silent."""
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return None
    try:
        handle = pynvml.nvmlDeviceGetHandleByIndex(device)
        return float(pynvml.nvmlDeviceGetMemoryInfo(handle).used) / 1e6
    except pynvml.NVMLError:
        return None
    finally:
        pynvml.nvmlShutdown()


def energy(run: Run, provider: Provider) -> EnergyResult:
    """Measure joules a frame, by a counter of the device that runs the provider."""
    names = [f"nvml:{getattr(provider, 'device', 0)}", "ina3221"]
    if provider.native == CPU.native:
        names = ["rapl"]
    reasons = list[str]()
    for name in names:
        if name_in(name) not in ENERGY_COUNTERS.names():
            reasons.append(f"{name}: examples/energy_counters is not installed")
            continue
        counter = open_counter(name)
        if isinstance(counter, Reader):
            try:
                return EnergyMeter(counter, SCHEDULE).measure({"frame": run})["frame"]
            except EnergyError as error:
                return EnergyResult(reason=str(error))
            finally:
                counter.close()
        reasons.append(counter.reason if isinstance(counter, Absent) else name)
    return EnergyResult(reason="; ".join(reasons))


def measured(given: Any) -> dict[str, Any]:
    """Open, run, and weigh one file."""
    provider = provider_named(given.provider)
    device = getattr(provider, "device", 0)
    with np.load(given.frame) as held:
        feeds = {name: np.ascontiguousarray(held[name]) for name in held}
    before = gpu_used_mb(device)
    open_session = bound_session if given.bound else our_session
    run, outputs = open_session(given.model, feeds, provider, given)
    wall_s = timed(run, given.warm_up, given.runs, given.seconds)
    after = gpu_used_mb(device)
    arrays: dict[str, Any] = {name: np.asarray(a) for name, a in outputs().items()}
    np.savez(given.out, **arrays)
    reason = "NVML does not answer" if None in (before, after) else ""
    if provider.native == CPU.native:
        reason = "runs on the CPU"
    taken = 0.0 if before is None or after is None else after - before
    return {
        "wall_s": wall_s,
        "gpu_mb": None if reason else taken,
        "gpu_reason": reason,
        "host_mb": peak_mb(),
        "energy": dataclasses.asdict(
            energy(run, provider) if given.energy else EnergyResult(reason="not asked")
        ),
    }


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("model", type=Path)
    parser.add_argument("frame", type=Path)
    parser.add_argument("out", type=Path)
    parser.add_argument("--provider", default="cpu")
    parser.add_argument("--stock", action="store_true")
    parser.add_argument("--bound", action="store_true")
    parser.add_argument("--threads", type=int, default=0)
    parser.add_argument("--warm-up", type=int, default=20)
    parser.add_argument("--runs", type=int, default=200)
    parser.add_argument("--seconds", type=float, default=60)
    parser.add_argument("--energy", action="store_true")
    try:
        print(json.dumps(measured(parser.parse_args())))
    except Me2eError as error:
        sys.exit(str(error))


if __name__ == "__main__":
    main()
