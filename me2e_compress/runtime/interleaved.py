"""Interleaved timing: models measured in turn, so that noise falls on all of them."""

import dataclasses
from collections.abc import Callable, Iterator, Mapping, Sequence
from itertools import chain, islice, repeat
from pathlib import Path
from statistics import median
from time import perf_counter, process_time

from me2e_compress.runtime.any_session import AnySession
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
from me2e_compress.runtime.session import replay
from me2e_compress.runtime.stack.split_stack import digest_of_files

BLOCK = 10
"""Inferences of one model in a row: as warm as alone, and a noise that lasts a second
falls on all models."""
RE_WARM = 2
"""Inferences at the start of a block that do not count: the caches are another's."""


@dataclasses.dataclass(frozen=True)
class RunTimes:
    """Times of one model, round by round.

    Attributes:
        wall_s: seconds on the clock.
        cpu_s: seconds of CPU, all threads together.
    """

    wall_s: tuple[float, ...]
    cpu_s: tuple[float, ...]

    @property
    def median_wall_s(self) -> float:
        """Median wall time, seconds."""
        return median(self.wall_s)

    @property
    def best_wall_s(self) -> float:
        """Least wall time, seconds: that of an idle machine."""
        return min(self.wall_s)


def time_interleaved(
    sessions: Mapping[str, AnySession],
    frames: Sequence[Frame],
    rounds: int,
    on_run: Callable[[int, int, str], None] | None = None,
) -> dict[str, RunTimes]:
    """Time one frame of every model in turn, A B C A B C, after a round unmeasured.

    Args:
        sessions: the models by name, all with the same number of threads.
        frames: the first one is run, with recurrent state at zeros.
        rounds: how often each is measured.
        on_run: called with runs done, runs in all and the model's name.
    """
    wall: dict[str, list[float]] = {name: [] for name in sessions}
    cpu: dict[str, list[float]] = {name: [] for name in sessions}
    total = (rounds + 1) * len(sessions)
    for turn in range(rounds + 1):
        for place, (name, session) in enumerate(sessions.items()):
            if on_run is not None:
                on_run(turn * len(sessions) + place, total, name)
            start, used = perf_counter(), process_time()
            for _ in replay(session, frames[:1]):
                pass
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
    """Record the latency of models, each warm and alone, block by block in turn.

    Recurrent state is fed forward and reset where scenes begin; the recording is
    repeated as often as it takes.

    Args:
        models: ONNX files, or TOMLs of stacks, by name.
        frames: the recording.
        samples: latencies of each model.
        warm_up: inferences of each before the first block.
        threads: of onnxruntime.
        provider: what runs them.
        on_sample: called with samples done, samples in all and the model's name.

    Raises:
        EvaluationError: there is nothing to measure.
        GraphError: a model cannot be run.
        ProviderError: the provider is not there.
        FramesError: a frame does not fit.
    """
    check_work(samples, warm_up, frames)
    sessions = {
        name: TimedSession(path, threads=threads, provider=provider)
        for name, path in models.items()
    }
    runs = {
        name: replay(session, chain.from_iterable(repeat(frames)))
        for name, session in sessions.items()
    }
    kept = {name: list[int]() for name in models}
    for run in runs.values():
        _advance(run, warm_up)
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
            digest_of_files(path), machine, tuple(kept[name]), others=others.load
        )
        for name, path in models.items()
    }


def describe_machine(threads: int, provider: Provider = CPU) -> str:
    """Return the machine of `record_traces`, in words: processor, threads, provider."""
    return f"{machine_words(threads, provider)}, in turn"


def _advance(runs: Iterator[object], count: int) -> None:
    for _ in islice(runs, count):
        pass
