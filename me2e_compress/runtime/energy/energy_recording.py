"""A recording of energy over time with the frames done, and windows cut from it."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_result import EnergyResult
from me2e_compress.runtime.energy.energy_summary import CountedBy, summarise
from me2e_compress.runtime.energy.estimate import FEWEST_WINDOWS, Window
from me2e_compress.runtime.energy.schedule import EnergySchedule

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
