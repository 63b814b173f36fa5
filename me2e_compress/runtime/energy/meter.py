"""Measure the energy of models in alternating windows, with idle before and after."""

import contextlib
import dataclasses
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import AbstractContextManager
from functools import partial
from itertools import chain, pairwise, repeat
from pathlib import Path
from statistics import fmean, median
from threading import Event, Thread

import numpy as np

from me2e_compress.base.errors import EnergyError
from me2e_compress.graph import sha256_of
from me2e_compress.runtime.energy.energy_counter import (
    EnergyRecording,
    EnergySchedule,
    integrate_power,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import (
    Absent,
    EnergyResult,
    Reader,
    Window,
    summarise,
)
from me2e_compress.runtime.frames import Frame, Frames
from me2e_compress.runtime.providers import CPU, Provider
from me2e_compress.runtime.session import Session, replay

# Seconds between samples of the power: five within a usual step of 0.1 s.
SAMPLED_S = 0.02
# Fewest samples in a window from which its integral is used
FEWEST_SAMPLES = 20


@contextlib.contextmanager
def call_repeatedly(period_s: float, call: Callable[[], None]) -> Iterator[None]:
    """Call a function periodically in a thread while the context is open."""
    stop, errors = Event(), list[EnergyError]()

    def repeat() -> None:
        while not stop.wait(period_s) and not errors:
            try:
                call()
            except EnergyError as error:
                errors.append(error)

    # A daemon thread does not keep a failed process alive.
    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        stop.set()
        thread.join()
    # An error in the thread is raised where the context is left
    if errors:
        raise errors[0]


# Runs one frame of a model and returns when it is done, on the device too
Work = Callable[[], object]
# Calls a function every so many seconds while the context is open
Repeater = Callable[[float, Callable[[], None]], AbstractContextManager[None]]


class EnergyMeter:
    """Measure several models side by side with one counter.

    Nothing else may run on the device of ``reader``; ``on_window`` is called with
    windows done, windows in all, and the model's name.
    """

    def __init__(
        self,
        reader: Reader,
        schedule: EnergySchedule | None = None,
        *,
        clock: Callable[[], float] = time.perf_counter,
        sleep: Callable[[float], None] = time.sleep,
        every: Repeater = call_repeatedly,
        on_window: Callable[[int, int, str], None] = lambda done, total, name: None,
    ) -> None:
        self._reader, self._schedule = reader, schedule or EnergySchedule()
        self._clock, self._sleep, self._every = clock, sleep, every
        self._on_window = on_window
        self._random = np.random.default_rng(self._schedule.seed)
        self._power = list[tuple[float, float]]()  # seconds and watts

    def measure(self, work: Mapping[str, Work]) -> dict[str, EnergyResult]:
        """Measure models in turn; ``work`` maps each name to what runs one frame."""
        windows: dict[str, list[Window]] = {name: [] for name in work}
        slowed: dict[str, list[str]] = {name: [] for name in work}
        reader, schedule = self._reader, self._schedule
        turns = schedule.turns(list(work))
        rest = partial(self._sleep, schedule.idle_s)
        with (
            contextlib.nullcontext()
            if reader.counts
            else self._every(SAMPLED_S, self._sample_power)
        ):
            # The idle device with the models loaded, then a warm-up of all together
            idle = [self._window(0, rest)]
            frame_s = self._warm_up(work)
            # Windows in turn (A B B A), so that drift falls on all models alike
            for done, name in enumerate(turns):
                self._on_window(done, len(turns), name)
                frames = schedule.frames(frame_s[name])
                window = self._run_window(work[name], frames, slowed[name])
                windows[name].append(window)
            self._on_window(len(turns), len(turns), turns[-1])
            self._sleep(schedule.lead_in_s)
            idle.append(self._window(0, rest))
            self._sleep(2 * SAMPLED_S)  # the last sample of power comes after it
        # Idle power is the mean of before and after.
        idle_w = fmean(self._integrated(window).watts for window in idle)
        return {
            name: summarise(
                [self._integrated(window) for window in windows[name]],
                (reader.counter, reader.device, reader.scope, reader.step_s),
                idle_w,
                slowed[name],
            )
            for name in work
        }

    def _sample_power(self) -> None:
        self._power.append((self._clock(), self._reader.watts()))

    def _integrated(self, window: Window) -> Window:
        """Return a window with its integrated power where no joules are counted."""
        reader, begin_s, end_s = self._reader, window.begin_s, window.end_s
        if reader.counts:
            return window
        count = sum(begin_s <= time_s <= end_s for time_s, _ in self._power)
        if count < FEWEST_SAMPLES:
            raise EnergyError(
                f"{reader.counter} of {reader.device}: power was read {count} times in"
                f" {end_s - begin_s:.1f} s, at least {FEWEST_SAMPLES} are needed"
            )
        times, watts = np.array(self._power).T
        so_far = np.interp([begin_s, end_s], times, integrate_power(times, watts))
        return dataclasses.replace(window, joules=float(so_far[1] - so_far[0]))

    def _window(self, frames: int, wait: Callable[[], object]) -> Window:
        """Measure what happens meanwhile, without joules where power is integrated."""
        reader = self._reader
        before = reader.joules() if reader.counts else 0.0
        begin = self._clock()
        wait()
        after = reader.joules() if reader.counts else 0.0
        end = self._clock()
        if reader.counts and after <= before:
            what = f"stands still at {after:g} J for {end - begin:.1f} s"
            if after < before:
                what = f"went back from {before:g} to {after:g} J"
            raise EnergyError(
                f"energy counter {reader.counter} of {reader.device} {what}"
            )
        return Window(begin, end, frames, after - before)

    def _warm_up(self, work: Mapping[str, Work]) -> dict[str, float]:
        """Warm up all models in turn; return the seconds of a frame of each."""
        frame_times: dict[str, list[float]] = {name: [] for name in work}
        until = self._clock() + self._schedule.warm_up_s
        while self._clock() < until or not all(frame_times.values()):
            for name, run in work.items():
                frame_times[name] += self._lead_in(run)
        return {name: median(times) for name, times in frame_times.items()}

    def _lead_in(self, run: Work) -> list[float]:
        """Run frames for `lead_in_s`; return the seconds of each."""
        times = [self._clock()]
        while times[-1] - times[0] < self._schedule.lead_in_s:
            run()
            times.append(self._clock())
        return [after - before for before, after in pairwise(times)]

    def _run_window(self, run: Work, frames: int, slowed: list[str]) -> Window:
        """Run a window at a random phase of the counter; add to ``slowed`` why."""
        # The lead-in follows the wait: caches must hold this model.
        self._sleep(float(self._random.uniform(0, self._reader.step_s)))
        slowed += self._reader.throttled()
        self._lead_in(run)

        def work() -> None:
            for _ in range(frames):
                run()

        window = self._window(frames, work)
        slowed += self._reader.throttled()
        return window


# Bytes of frames held in memory: reading from disk takes energy too.
MOST_BYTES = 500_000_000


def measure_energy(
    models: Mapping[str, Path],
    frames: Frames,
    counter: str = "auto",
    schedule: EnergySchedule | None = None,
    *,
    threads: int = 1,
    provider: Provider = CPU,
    metadata: Mapping[str, str] | None = None,
    on_window: Callable[[int, int, str], None] = lambda done, total, name: None,
) -> dict[str, EnergyResult]:
    """Measure the energy of models, one frame at a time, in alternating windows.

    Recurrent state is fed forward and reset where scenes begin. Nothing else may run on
    the device. ``models`` has ONNX files by name; ``counter`` is a text for
    :func:`open_counter`; ``metadata`` overrides the models' own; ``on_window`` is
    called with windows done, windows in all, and the model's name.

    Returns joules per frame by model; without a counter, the reason why not, at once. A
    counter that fails, or a recording of several models, is an EnergyError.
    """
    digests = {name: sha256_of(path) for name, path in models.items()}
    # Measure, take the recording, or say why there is no counter.
    opened = open_counter(counter)
    if isinstance(opened, Absent):
        results = dict.fromkeys(models, EnergyResult(reason=opened.reason))
    elif isinstance(opened, EnergyRecording):
        if len(models) != 1:
            raise EnergyError(
                f"energy {counter}: a recording is of one model, and there are"
                f" {len(models)}: {', '.join(models)}"
            )
        results = dict.fromkeys(models, opened.measured(schedule or EnergySchedule()))
    else:
        with contextlib.closing(opened):
            work = _open_models(models, frames, threads, provider, metadata)
            meter = EnergyMeter(opened, schedule, on_window=on_window)
            results = meter.measure(work)
    # Each result carries the digest of its model's files.
    return {
        name: dataclasses.replace(result, model_sha256=digests[name])
        for name, result in results.items()
    }


def _open_models(
    models: Mapping[str, Path],
    frames: Frames,
    threads: int,
    provider: Provider,
    metadata: Mapping[str, str] | None,
) -> dict[str, Work]:
    """Open each model, to replay endlessly the first frames that fit into memory."""
    # Frames are held in memory: reading from disk takes energy too
    in_memory, size = list[Frame](), 0
    for frame in frames:
        size += sum(array.nbytes for array in frame.arrays.values())
        if in_memory and size > MOST_BYTES:
            break
        in_memory.append(frame)
    if not in_memory:
        raise EnergyError("energy: there is no frame to run")
    sessions = {
        name: Session(
            path,
            threads=threads,
            int8_kernels=True,
            provider=provider,
            metadata=metadata,
        )
        for name, path in models.items()
    }
    return {
        name: replay(session, chain.from_iterable(repeat(in_memory))).__next__
        for name, session in sessions.items()
    }
