"""Measure the latency of a warm model, alone on this machine."""

import platform
from collections import deque
from collections.abc import Callable, Mapping
from itertools import chain, islice, repeat
from pathlib import Path

from me2e_compress.base.display import plural
from me2e_compress.base.errors import EvaluationError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.frames import Frames
from me2e_compress.runtime.latency_trace import LatencyTrace, OthersLoad
from me2e_compress.runtime.providers import CPU, PROVIDERS, Provider
from me2e_compress.runtime.session import Session, replay

WARM_UP = 10


def profile(
    model: Path,
    frames: Frames,
    *,
    samples: int | None = None,
    warm_up: int = WARM_UP,
    threads: int = 1,
    provider: Provider = CPU,
    metadata: Mapping[str, str] | None = None,
    on_sample: Callable[[int, int], None] = lambda done, total: None,
) -> LatencyTrace:
    """Measure the latency of a model on every frame, one at a time.

    Recurrent state is fed forward and reset where scenes begin. By default there is one
    sample a frame. ``metadata`` overrides the model's own; ``on_sample`` is called with
    samples done and all samples.
    """
    wanted = len(frames) if samples is None else samples
    check_counts(wanted, warm_up, frames)
    session = Session(
        model, threads=threads, int8_kernels=True, provider=provider, metadata=metadata
    )
    # Warm up and measure in one replay of the repeated recording
    endless, durations_us = chain.from_iterable(repeat(frames)), list[int]()
    for done, _ in enumerate(islice(replay(session, endless), warm_up + wanted), 1):
        durations_us.append(session.last_us)
        on_sample(max(0, done - warm_up), wanted)
    machine = machine_text(threads, provider)
    return LatencyTrace(sha256_of(model), machine, tuple(durations_us[warm_up:]))


def machine_text(threads: int, provider: Provider = CPU) -> str:
    """Describe what measures: processor, threads, a provider other than the CPU."""
    runs = "" if provider == CPU else f", {PROVIDERS.text(provider)}"
    on = plural(threads, "thread") if threads else "all threads"
    return f"{processor()}, {provider.engine} on {on}{runs}"


def check_counts(samples: int, warm_up: int, frames: Frames) -> None:
    """Raise an EvaluationError unless there are a sample and a frame to measure."""
    if samples < 1 or warm_up < 0 or not len(frames):
        raise EvaluationError(
            f"{samples} samples after {warm_up} of warm-up on {len(frames)} frames: "
            "at least one sample and one frame are needed"
        )


def processor() -> str:
    """Return the name of this machine's processor, as the system reports it."""
    table = Path("/proc/cpuinfo")
    if table.is_file():
        for line in table.read_text("utf-8").splitlines():
            key, _, value = line.partition(":")
            if key.strip() == "model name":
                return value.strip()
    return platform.processor() or platform.machine()


# Interleaved timing: models measured in turn, so that noise affects all of them.


# Inferences of one model in a row: caches stay warm, and noise that lasts a second
# affects all models.
BLOCK_RUNS = 10
# Uncounted inferences at the start of a block: the caches hold another model's data.
BLOCK_WARM_UP = 2


def record_traces(
    models: Mapping[str, Path],
    frames: Frames,
    *,
    samples: int,
    warm_up: int = WARM_UP,
    threads: int = 1,
    provider: Provider = CPU,
    metadata: Mapping[str, Mapping[str, str]] | None = None,
    on_sample: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, LatencyTrace]:
    """Record the latency of models, each warm, in alternating blocks.

    Recurrent state is fed forward and reset where scenes begin. ``models`` has ONNX
    files, ``metadata`` that of them; ``samples`` and ``warm_up`` count for each model;
    ``on_sample`` is called with samples done, all samples and the model's name.
    """
    check_counts(samples, warm_up, frames)
    sessions = {
        name: Session(
            path,
            threads=threads,
            int8_kernels=True,
            provider=provider,
            metadata=(metadata or {}).get(name),
        )
        for name, path in models.items()
    }
    # Every model replays the recording endlessly, and warms up.
    runs = {
        name: replay(session, chain.from_iterable(repeat(frames)))
        for name, session in sessions.items()
    }
    durations_us = {name: list[int]() for name in models}
    for run in runs.values():
        deque(islice(run, warm_up), maxlen=0)
    # Measure block by block, and discard the start of each.
    total = samples * len(models)
    with OthersLoad() as others:
        for done in range(0, samples, BLOCK_RUNS):
            block = min(BLOCK_RUNS, samples - done)
            for position, (name, session) in enumerate(sessions.items()):
                timed = islice(runs[name], BLOCK_WARM_UP + block)
                block_us = [session.last_us for _ in timed]
                durations_us[name] += block_us[BLOCK_WARM_UP:]
                on_sample(done * len(models) + position * block, total, name)
    machine = in_turn_text(threads, provider)
    return {
        name: LatencyTrace(
            sha256_of(path), machine, tuple(durations_us[name]), others=others.load
        )
        for name, path in models.items()
    }


def in_turn_text(threads: int, provider: Provider = CPU) -> str:
    """Describe what measures in `record_traces`; see :func:`machine_text`."""
    return f"{machine_text(threads, provider)}, in turn"
