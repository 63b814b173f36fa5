"""Energy counters of devices, and the registry of them.

To add one, write its class and its reader, then add it to this table.
"""

import abc
import csv
import io
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

import numpy as np
import numpy.typing as npt

from me2e_compress.base import documents
from me2e_compress.base.display import with_prefix
from me2e_compress.base.errors import EnergyError
from me2e_compress.base.registry import Registry
from me2e_compress.runtime.energy.energy_result import (
    FEWEST_WINDOWS,
    Absent,
    EnergyResult,
    Reader,
    Window,
    summarise,
)


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
        forth, back = list(models), list(reversed(models))
        return [
            name
            for turn in range(self.windows)
            for name in (back if turn % 2 else forth)
        ]


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
        """Return the energy of the model; an EnergyError of too few windows."""
        # Find the stretch in which frames are done, and skip the warm-up
        working = np.flatnonzero(np.diff(self.frames) > 0)
        if not len(working):
            raise EnergyError("energy recording: no frame is done in it")
        times, first, last = self.times_s, int(working[0]), int(working[-1]) + 1
        at = int(np.searchsorted(times, times[first] + schedule.warm_up_s))
        # Cut windows, long enough and of enough frames, until the rest is too short
        windows = list[Window]()
        while at < last:
            end_by_time = int(np.searchsorted(times, times[at] + schedule.window_s))
            frames_at_end = self.frames[at] + schedule.window_frames
            end = max(end_by_time, int(np.searchsorted(self.frames, frames_at_end)))
            if end > last:
                break
            windows.append(self._window(at, end))
            at = end
        if len(windows) < FEWEST_WINDOWS:
            raise EnergyError(
                f"energy recording: {len(windows)} windows of {schedule.window_s:g} s"
                f" and {schedule.window_frames} frames after a warm-up of"
                f" {schedule.warm_up_s:g} s: at least {FEWEST_WINDOWS} are needed"
            )
        # Idle power is the mean before and after the work, unless both are short
        idle = [
            self._window(begin, end)
            for begin, end in ((0, first), (last, len(times) - 1))
            if times[end] - times[begin] >= schedule.idle_s
        ]
        idle_w = sum(window.watts for window in idle) / len(idle) if idle else None
        step_s = float(np.median(np.diff(times)))
        return summarise(
            windows, (self.counter, self.device, self.scope, step_s), idle_w
        )

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


# Tries every counter of this machine in turn
AUTO = "auto"


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
        """Open the counter and check that it answers; an EnergyError of a bad file."""


_HERE = "me2e_compress.runtime.energy"

ENERGY_COUNTERS: Registry[EnergyCounter] = Registry(
    "energy counter",
    "me2e_compress.energy_counters",
    EnergyError,
    {"nvml": f"{_HERE}.nvml:Nvml", "recorded": f"{_HERE}.energy_counter:Recorded"},
)


def open_counter(text: str = AUTO) -> Reader | EnergyRecording | Absent:
    """Open a counter by its text, e.g. ``nvml:1`` or ``recorded:FILE``.

    ``auto`` opens the first that answers on this machine, or returns an :class:`Absent`
    with all answers. An unknown counter or option, or a bad file, is an EnergyError.
    """
    if text.strip() != AUTO:
        counters = [ENERGY_COUNTERS.parse(text)]
    else:
        kinds = map(ENERGY_COUNTERS.get, ENERGY_COUNTERS.usable())
        counters = [ENERGY_COUNTERS.make(kind, {}) for kind in kinds if kind.automatic]
    answers = list[str]()
    for counter in counters:
        opened = counter.open()
        if not isinstance(opened, Absent):
            return opened
        answers.append(with_prefix(counter.name, opened.reason))
    return Absent(f"no energy counter answers ({'; '.join(answers)})")


def check_counter(text: str) -> None:
    """Check a counter's text by opening and closing it; raises as `open_counter`."""
    # A counter that is absent on this machine passes
    counter = open_counter(text)
    if isinstance(counter, Reader):
        counter.close()


def integrate_power(times_s: Floats, watts: Floats) -> Floats:
    """Return the joules [n] since the first of the times [n], by trapezoids."""
    steps = np.diff(times_s) * (watts[1:] + watts[:-1]) / 2
    return np.concatenate([[0.0], np.cumsum(steps)])


@dataclass(frozen=True)
class Recorded(EnergyCounter):
    """A CSV file of the energy or the power that was recorded on the target device.

    Attributes:
        file: has the columns ``time_s``, ``frames`` (inferences done so far), and
            ``joules`` (so far) or ``watts`` (at that time).
    """

    name: ClassVar[str] = "recorded"
    automatic: ClassVar[bool] = False
    file: Path

    def open(self) -> EnergyRecording:
        """Read the file and check it."""
        try:
            return _recording(_read_columns(self.file), self.file.name)
        except OSError as error:
            raise EnergyError(f"{self.file}: {error.strerror}") from error
        except (documents.MalformedError, ValueError, csv.Error) as error:
            raise EnergyError(
                f"{self.file}: not an energy recording: {error}"
            ) from error


def _read_columns(path: Path) -> Mapping[str, Floats]:
    """Return a CSV file's columns by name; a ValueError of rows of other lengths."""
    content = documents.read_bytes(path)
    lines = csv.reader(io.StringIO(content.decode("utf-8-sig")))
    header = [name.strip() for name in next(lines, [])]
    rows = [line for line in lines if line]
    for number, line in enumerate(rows, 2):
        if len(line) != len(header):
            raise ValueError(
                f"line {number} has {len(line)} values, the header {len(header)}"
            )
    table = np.array(rows, np.float64).reshape(len(rows), len(header))
    return dict(zip(header, table.T, strict=True))


def _recording(columns: Mapping[str, Floats], name: str) -> EnergyRecording:
    """Build a recording; a ValueError names the first row that does not fit."""
    power_or_energy = "joules" if "joules" in columns else "watts"
    for column in ("time_s", "frames", power_or_energy):
        if column not in columns:
            there = ", ".join(columns) or "none"
            raise ValueError(
                f"no column {column}; there are {there}, wanted: time_s, frames, and"
                " joules or watts"
            )
        _check_rows(f"{column} is not finite", ~np.isfinite(columns[column]))
    times, frames = columns["time_s"], columns["frames"]
    values = columns[power_or_energy]
    if len(times) < 2:
        raise ValueError("a recording has 2 rows or more")
    # Time and counts never go back
    _check_rows("time_s does not ascend", np.diff(times) <= 0)
    _check_rows("frames go back", np.diff(frames) < 0)
    if power_or_energy == "joules":
        _check_rows("joules go back", np.diff(values) < 0)
        joules, counter = values, "recorded"
    else:
        _check_rows("watts are negative", values < 0)
        joules, counter = integrate_power(times, values), "recorded-power-integrated"
    return EnergyRecording(times, joules, frames, name, "as recorded", counter)


def _check_rows(fault: str, wrong: npt.NDArray[np.bool_]) -> None:
    """Raise a ValueError that names the first wrong row, counted from 1."""
    if wrong.any():
        raise ValueError(f"{fault} at row {int(np.argmax(wrong)) + 1}")
