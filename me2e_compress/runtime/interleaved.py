"""Interleaved timing: models measured in turn, so that noise affects all of them."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice, repeat
from pathlib import Path
from time import perf_counter, process_time

from me2e_compress.graph import sha256_of
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.latency_trace import LatencyTrace
from me2e_compress.runtime.others_load import OthersLoad
from me2e_compress.runtime.profile import (
    WARM_UP,
    TimedSession,
    check_work,
    machine_words,
)
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

BLOCK = 10
"""Inferences of one model in a row: caches stay warm, and noise that lasts a second
affects all models."""
RE_WARM = 2
"""Uncounted inferences at the start of a block: the caches hold another model's
data."""


@dataclasses.dataclass(frozen=True)
class RunTimes:
    """Times of one model, one for each round; CPU time adds up all threads."""

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]

    @property
    def best_wall_s(self) -> float:
        """The least wall time in seconds: that of an idle machine."""
        return min(self.wall_s)


def time_interleaved(
    sessions: Mapping[str, Session], frames: Sequence[Frame], rounds: int
) -> dict[str, RunTimes]:
    """Time one frame of every model in turn, A B C A B C, after one uncounted round.

    All models should have the same number of threads. Only the first frame is run, with
    recurrent state at zeros.
    """
    wall: dict[str, list[float]] = {name: [] for name in sessions}
    cpu: dict[str, list[float]] = {name: [] for name in sessions}
    for turn in range(rounds + 1):
        for name, session in sessions.items():
            start, used = perf_counter(), process_time()
            for _ in replay(session, frames[:1]):
                pass
            # The first round only warms up.
            if turn:
                wall[name].append(perf_counter() - start)
                cpu[name].append(process_time() - used)
    return {name: RunTimes(tuple(wall[name]), tuple(cpu[name])) for name in sessions}


def record_traces(
    models: Mapping[str, Path],
    frames: Frames,
    *,
    samples: int,
    warm_up: int = WARM_UP,
    threads: int = 1,
    provider: Provider = CPU,
    on_sample: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, LatencyTrace]:
    """Record the latency of models, each warm, in alternating blocks.

    Recurrent state is fed forward and reset where scenes begin; the recording is
    repeated as often as needed. ``models`` has ONNX files;
    ``samples`` and ``warm_up`` count for each model; ``on_sample`` is called with
    samples done, all samples and the model's name.
    """
    check_work(samples, warm_up, frames)
    sessions = {
        name: TimedSession(path, threads=threads, provider=provider)
        for name, path in models.items()
    }
    # Every model replays the recording endlessly, and warms up.
    runs = {
        name: replay(session, chain.from_iterable(repeat(frames)))
        for name, session in sessions.items()
    }
    kept = {name: list[int]() for name in models}
    for run in runs.values():
        _advance(run, warm_up)
    # Measure block by block, and discard the start of each.
    total = samples * len(models)
    with OthersLoad() as others:
        for done in range(0, samples, BLOCK):
            block = min(BLOCK, samples - done)
            for place, (name, session) in enumerate(sessions.items()):
                _advance(runs[name], RE_WARM + block)
                kept[name] += session.taken_us[-block:]
                on_sample(done * len(models) + place * block, total, name)
    machine = describe_machine(threads, provider)
    return {
        name: LatencyTrace(
            sha256_of(path), machine, tuple(kept[name]), others=others.load
        )
        for name, path in models.items()
    }


def describe_machine(threads: int, provider: Provider = CPU) -> str:
    """Describe the machine of `record_traces`: processor, threads, provider."""
    return f"{machine_words(threads, provider)}, in turn"


def _advance(runs: Iterator[object], count: int) -> None:
    for _ in islice(runs, count):
        pass
