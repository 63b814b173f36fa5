"""Energy counters of devices, and the registry of them.

To add one, write its class and its reader, then add it to this table.
"""

import abc
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.display import prefixed
from me2e_compress.errors import EnergyError
from me2e_compress.registry import Registry
from me2e_compress.runtime.energy.energy_result import (
    FEWEST_WINDOWS,
    Absent,
    CountedBy,
    EnergyResult,
    Reader,
    Window,
    summarise,
)

# The schedule of an energy measurement: warm-up, idle, and alternating windows.


@dataclass(frozen=True)
class EnergySchedule:
    """Durations and counts; the paper measures 100 frames after 30 s, once.

    Attributes:
        warm_up_s: work before the first window, seconds, all models together.
        window_s: least seconds of a window: the counter's step of 0.1 s is 1 %.
        window_frames: least frames of a window.
        windows: number of windows of each model.
        idle_s: seconds for which the idle device is measured, before and after.
        lead_in_s: seconds of frames of the same model just before a window: the counter
            lags by a step, and clocks and caches settle.
        seed: of the random phases at which windows begin.
    """

    warm_up_s: float = 30.0
    window_s: float = 10.0
    window_frames: int = 100
    windows: int = 12
    idle_s: float = 10.0
    lead_in_s: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if self.windows < FEWEST_WINDOWS:
            raise EnergyError(
                f"energy: {self.windows} windows: at least {FEWEST_WINDOWS} are needed"
                " for an interval"
            )
        for name in ("warm_up_s", "window_s", "window_frames", "idle_s", "lead_in_s"):
            value = getattr(self, name)
            if not (0 < value < math.inf):
                raise EnergyError(f"energy: {name} {value:g} is not a positive number")
        if self.seed < 0:
            raise EnergyError(f"energy: seed {self.seed}: must be 0 or more")

    def frames(self, frame_s: float) -> int:
        """Return the frames in a window of a model that takes ``frame_s`` a frame."""
        return max(self.window_frames, math.ceil(self.window_s / frame_s))

    def turns(self, models: Sequence[str]) -> list[str]:
        """Return the models in order of their windows: A B B A spreads drift evenly."""
        there, back = list(models), list(reversed(models))
        return [
            each
            for turn in range(self.windows)
            for each in (back if turn % 2 else there)
        ]


# A recording of energy over time with the frames done, and windows cut from it.


Floats = npt.NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class EnergyRecording:
    """What a device counted while one model ran on it.

    ``times_s`` ascends; ``joules`` counts from an arbitrary start; ``frames`` is the
    number of inferences done so far: where it is constant, the device is idle.
    """

    times_s: Floats
    joules: Floats
    frames: Floats
    device: str
    scope: str
    counter: str

    def measured(self, schedule: EnergySchedule) -> EnergyResult:
        """Return the energy of the model; EnergyError if the recording is too short."""
        by = CountedBy(self.counter, self.device, self.scope, self.step_s())
        return summarise(self.windows(schedule), by, self.idle_w(schedule))

    def windows(self, schedule: EnergySchedule) -> list[Window]:
        """Cut consecutive windows from the work after the warm-up."""
        # Find the stretch in which frames are done, and skip the warm-up.
        working = np.flatnonzero(np.diff(self.frames) > 0)
        if not len(working):
            raise EnergyError("energy recording: no frame is done in it")
        first, last = int(working[0]), int(working[-1]) + 1
        start = self.times_s[first] + schedule.warm_up_s
        at = int(np.searchsorted(self.times_s, start))
        # Cut windows until the rest is too short for another one.
        found = list[Window]()
        while at < last:
            end = self._end(at, last, schedule)
            if end is None:
                break
            found.append(self._window(at, end))
            at = end
        if len(found) < FEWEST_WINDOWS:
            raise EnergyError(
                f"energy recording: {len(found)} windows of {schedule.window_s:g} s and"
                f" {schedule.window_frames} frames after a warm-up of"
                f" {schedule.warm_up_s:g} s: at least {FEWEST_WINDOWS} are needed"
            )
        return found

    def idle_w(self, schedule: EnergySchedule) -> float | None:
        """Return the mean watts before and after the work; None if both are short."""
        working = np.flatnonzero(np.diff(self.frames) > 0)
        # The stretches before the first frame and after the last.
        ends = ((0, int(working[0])), (int(working[-1]) + 1, len(self.times_s) - 1))
        idle = [
            self._window(begin, end)
            for begin, end in ends
            if self.times_s[end] - self.times_s[begin] >= schedule.idle_s
        ]
        return sum(each.watts for each in idle) / len(idle) if idle else None

    def step_s(self) -> float:
        """Return the median seconds between rows."""
        return float(np.median(np.diff(self.times_s)))

    def _end(self, at: int, last: int, schedule: EnergySchedule) -> int | None:
        """Return the last row of the window that begins at ``at``; None: too late."""
        long = int(np.searchsorted(self.times_s, self.times_s[at] + schedule.window_s))
        many = self.frames[at] + schedule.window_frames
        end = max(long, int(np.searchsorted(self.frames, many)))
        return end if end <= last else None

    def _window(self, begin: int, end: int) -> Window:
        joules = float(self.joules[end] - self.joules[begin])
        times = float(self.times_s[begin]), float(self.times_s[end])
        if joules <= 0:
            went = "stands still" if joules == 0 else "goes back"
            raise EnergyError(
                f"energy recording: the counter {went} from {times[0]:g} to"
                f" {times[1]:g} s"
            )
        return Window(*times, int(self.frames[end] - self.frames[begin]), joules)


AUTO = "auto"
"""Tries every counter of this machine in turn."""


@dataclass(frozen=True)
class EnergyCounter(abc.ABC):
    """A kind of counter; its fields are its options.

    Class attributes:
        name: its name on the command line.
        automatic: whether ``auto`` may try it.
    """

    name: ClassVar[str]
    automatic: ClassVar[bool] = True

    @abc.abstractmethod
    def open(self) -> Reader | EnergyRecording | Absent:
        """Open the counter and check that it can be read.

        Raises:
            EnergyError: a file that it reads is not usable.
        """


_HERE = "me2e_compress.runtime.energy"

ENERGY_COUNTERS: Registry[EnergyCounter] = Registry(
    "energy counter",
    "me2e_compress.energy_counters",
    EnergyError,
    {
        "nvml": f"{_HERE}.nvml:Nvml",
        "recorded": f"{_HERE}.recorded_energy:Recorded",
    },
)


def open_counter(text: str = AUTO) -> Reader | EnergyRecording | Absent:
    """Open a counter by its text, e.g. ``nvml:1`` or ``recorded:FILE``.

    ``auto`` opens the first of :data:`ENERGY_COUNTERS` that answers on this machine; an
    :class:`Absent` has the answer of each counter tried.

    Raises:
        EnergyError: no such counter, an unknown option, or a file that is not usable.
    """
    if text.strip() != AUTO:
        return _first([ENERGY_COUNTERS.parse(text)])
    kinds = [ENERGY_COUNTERS.get(name) for name in ENERGY_COUNTERS.usable()]
    return _first([ENERGY_COUNTERS.make(kind, {}) for kind in kinds if kind.automatic])


def check_counter(text: str) -> None:
    """Check that a counter's text is valid by opening and closing it.

    A counter that is absent on this machine passes.

    Raises:
        EnergyError: no such counter, an unknown option, or a file that is not usable.
    """
    found = open_counter(text)
    if isinstance(found, Reader):
        found.close()


def _first(counters: Sequence[EnergyCounter]) -> Reader | EnergyRecording | Absent:
    answers = list[str]()
    for each in counters:
        found = each.open()
        if not isinstance(found, Absent):
            return found
        answers.append(prefixed(each.name, found.reason))
    return Absent(f"no energy counter answers ({'; '.join(answers)})")
