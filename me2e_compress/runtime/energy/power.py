"""Sample the power in the background and integrate it."""

import contextlib
from collections.abc import Callable, Iterator
from threading import Event, Thread

import numpy as np
import numpy.typing as npt

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.reader import Reader

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
