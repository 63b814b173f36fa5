"""How busy other processes keep the machine while something is measured."""

import os
import time
from collections.abc import Callable
from typing import Self

import psutil

BUSY = 0.1
"""Share of the cores that other processes may take before a latency is in doubt: their
work moves ours between cores and out of the caches, long before all cores are taken."""

SHORTEST_S = 0.5
"""What a block must take to be judged: systems count CPU time in ticks of 10 ms."""


class OthersLoad:
    """Counts the cores that other processes keep busy while a block runs.

    Args:
        machine: CPU seconds of all processes since the machine started.
        ours: CPU seconds of this process and the children that ended.
        clock: seconds that pass.

    Attributes:
        cores: mean over the block; None before it ends, or if it was too short.
        of: cores of the machine.
    """

    def __init__(
        self,
        machine: Callable[[], float] | None = None,
        ours: Callable[[], float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._machine, self._ours = machine or _machine_s, ours or _ours_s
        self._clock = clock
        self.cores: float | None = None
        self.of = os.cpu_count() or 1

    def __enter__(self) -> Self:
        """Begin to count."""
        self._begun = self._clock(), self._machine(), self._ours()
        return self

    def __exit__(self, *_: object) -> None:
        """Stop."""
        wall, machine, ours = (
            now - then
            for now, then in zip(
                (self._clock(), self._machine(), self._ours()), self._begun, strict=True
            )
        )
        self.cores = max(0.0, machine - ours) / wall if wall >= SHORTEST_S else None


def is_busy(cores: float | None, of: int) -> bool:
    """Return whether other processes take more than `BUSY` of a machine's cores."""
    return cores is not None and cores > BUSY * of


def _machine_s() -> float:
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)
    return float(sum(times) - idle - guests)  # guests are in user and nice already


def _ours_s() -> float:
    return sum(os.times()[:4])
