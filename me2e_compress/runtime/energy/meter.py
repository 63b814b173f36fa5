"""Measure the energy of models in alternating windows, with idle before and after."""

import contextlib
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from itertools import pairwise
from statistics import fmean, median
from threading import Event, Thread

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergySchedule
from me2e_compress.runtime.energy.energy_result import (
    CountedBy,
    DeviceState,
    EnergyResult,
    Reader,
    Window,
    summarise,
)

# Sample the power in the background and integrate it.


Floats = npt.NDArray[np.float64]

SAMPLED_S = 0.02
"""Seconds between samples of the power: five within a usual step of 0.1 s."""
FEWEST_SAMPLES = 20
"""Fewest samples in a window from which its integral is used."""


class PowerSamples:
    """Timed samples of a reader's power; ``clock`` returns seconds."""

    def __init__(self, reader: Reader, clock: Callable[[], float]) -> None:
        self._reader, self._clock = reader, clock
        self._taken = list[tuple[float, float]]()

    def add(self) -> None:
        """Sample the power once."""
        self._taken.append((self._clock(), self._reader.watts()))

    def count(self, begin_s: float, end_s: float) -> int:
        """Count the samples between two times."""
        return sum(begin_s <= each <= end_s for each, _ in self._taken)

    def joules(self, begin_s: float, end_s: float) -> float:
        """Return the energy between two times; too few samples are an error."""
        times, watts = np.array(self._taken or [(0.0, 0.0)]).T
        count = self.count(begin_s, end_s)
        if count < FEWEST_SAMPLES:
            raise EnergyError(
                f"{self._reader.counter} of {self._reader.device}: power was read"
                f" {count} times in {end_s - begin_s:.1f} s, at least {FEWEST_SAMPLES}"
                " are needed"
            )
        so_far = integrated(times, watts)
        return float(
            np.interp(end_s, times, so_far) - np.interp(begin_s, times, so_far)
        )


def integrated(times_s: Floats, watts: Floats) -> Floats:
    """Return the joules since the first time, at each time, by the trapezoidal rule."""
    steps = np.diff(times_s) * (watts[1:] + watts[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


@contextlib.contextmanager
def in_background(period_s: float, call: Callable[[], None]) -> Iterator[None]:
    """Call a function periodically in a thread while the context is open.

    An EnergyError of the call is raised when the context is left.
    """
    done, failed = Event(), list[EnergyError]()

    def repeat() -> None:
        while not done.wait(period_s) and not failed:
            try:
                call()
            except EnergyError as error:
                failed.append(error)

    # A daemon thread does not keep a failed process alive.
    thread = Thread(target=repeat, daemon=True)
    thread.start()
    try:
        yield
    finally:
        done.set()
        thread.join()
    # An error in the thread is raised here.
    if failed:
        raise failed[0]


Work = Callable[[], object]
"""Runs one frame of a model and returns when it is done, on the device too."""
Every = Callable[[float, Callable[[], None]], AbstractContextManager[None]]
"""Calls a function every so many seconds while the context is open."""


@dataclass(frozen=True)
class _Span:
    """A stretch between two readings; joules are None where power is integrated."""

    begin_s: float
    end_s: float
    frames: int
    joules: float | None
    states: tuple[DeviceState, ...] = ()


class EnergyMeter:
    """Measure several models side by side with one counter.

    The idle device is measured first, with the models loaded. The models then warm up
    together and take windows in turn (A B B A), each at a random phase of the counter
    and after lead-in frames of its own model. Idle is measured again at the end.
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
        every: Every = in_background,
        on_window: Callable[[int, int, str], None] = lambda done, total, name: None,
    ) -> None:
        self._reader, self._schedule = reader, schedule or EnergySchedule()
        self._clock, self._sleep, self._every = clock, sleep, every
        self._on_window = on_window
        self._random = np.random.default_rng(self._schedule.seed)
        self._power = PowerSamples(reader, clock)

    def measure(self, work: Mapping[str, Work]) -> dict[str, EnergyResult]:
        """Measure models in turn; ``work`` maps each name to what runs one frame."""
        spans: dict[str, list[_Span]] = {name: [] for name in work}
        turns = self._schedule.turns(list(work))
        with (
            self._every(SAMPLED_S, self._power.add)
            if self._reader.tells_power
            else contextlib.nullcontext()
        ):
            # Idle and warm up before the windows.
            idle = [self._idle()]
            frame_s = self._warm_up(work)
            # Alternate the models, so that drift falls on all alike.
            for done, name in enumerate(turns):
                self._on_window(done, len(turns), name)
                spans[name].append(self._work(work[name], frame_s[name]))
            self._on_window(len(turns), len(turns), turns[-1])
            self._sleep(self._schedule.lead_in_s)
            idle.append(self._idle())
            self._sleep(2 * SAMPLED_S)  # the last sample of power lies behind it
        # Idle power is the mean of before and after.
        idle_w = fmean(self._window(each).watts for each in idle)
        return {name: self._result(spans[name], idle_w) for name in work}

    def _result(self, spans: Sequence[_Span], idle_w: float) -> EnergyResult:
        reader = self._reader
        return summarise(
            [self._window(each) for each in spans],
            CountedBy(reader.counter, reader.device, reader.scope, reader.step_s),
            idle_w,
            states=[state for each in spans for state in each.states],
            power_j_per_frame=self._by_power(spans),
        )

    def _by_power(self, spans: Sequence[_Span]) -> float | None:
        """Return joules per frame by integrated power; None with too few samples."""
        ends = [(each.begin_s, each.end_s) for each in spans]
        fewest = min(self._power.count(*each) for each in ends)
        if not self._reader.counts or fewest < FEWEST_SAMPLES:
            return None
        joules = sum(self._power.joules(*each) for each in ends)
        return joules / sum(each.frames for each in spans)

    def _window(self, span: _Span) -> Window:
        joules = span.joules
        if joules is None:
            joules = self._power.joules(span.begin_s, span.end_s)
        return Window(span.begin_s, span.end_s, span.frames, joules)

    def _idle(self) -> _Span:
        begin, before = self._read()
        self._sleep(self._schedule.idle_s)
        end, after = self._read()
        return _Span(begin, end, 0, self._moved(before, after, end - begin))

    def _warm_up(self, work: Mapping[str, Work]) -> dict[str, float]:
        """Warm up all models in turn; return the seconds of a frame of each."""
        taken: dict[str, list[float]] = {name: [] for name in work}
        until = self._clock() + self._schedule.warm_up_s
        while self._clock() < until or not all(taken.values()):
            for name, run in work.items():
                taken[name] += self._lead_in(run)
        return {name: median(each) for name, each in taken.items()}

    def _lead_in(self, run: Work) -> list[float]:
        times = [self._clock()]
        while times[-1] - times[0] < self._schedule.lead_in_s:
            run()
            times.append(self._clock())
        return [after - before for before, after in pairwise(times)]

    def _work(self, run: Work, frame_s: float) -> _Span:
        """Run one window at a random phase of the counter."""
        frames = self._schedule.frames(frame_s)
        # The lead-in follows the wait: caches must hold this model.
        self._sleep(float(self._random.uniform(0, self._reader.step_s)))
        first = self._reader.state()
        self._lead_in(run)
        begin, before = self._read()
        for _ in range(frames):
            run()
        end, after = self._read()
        joules = self._moved(before, after, end - begin)
        states = (first, self._reader.state())
        return _Span(begin, end, frames, joules, states)

    def _read(self) -> tuple[float, float]:
        """Return the time and the joules; 0 joules where power is integrated."""
        joules = self._reader.joules() if self._reader.counts else 0.0
        return self._clock(), joules

    def _moved(self, before: float, after: float, taken_s: float) -> float | None:
        if not self._reader.counts:
            return None
        if after < before:
            raise EnergyError(self._says(f"went back from {before:g} to {after:g} J"))
        if after == before:
            raise EnergyError(
                self._says(f"stands still at {after:g} J for {taken_s:.1f} s")
            )
        return after - before

    def _says(self, what: str) -> str:
        return f"energy counter {self._reader.counter} of {self._reader.device} {what}"
