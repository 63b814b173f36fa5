"""Measure how busy other processes keep the machine during a measurement."""

import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Self

import psutil

BUSY = 0.1
"""Share of the cores that other processes may take before a latency is in doubt: they
move our threads between cores and evict caches long before all cores are taken."""

SHORTEST_S = 0.5
"""Shortest block to be judged, seconds: systems count CPU time in ticks of 10 ms."""


@dataclass(frozen=True)
class Load:
    """Mean number of cores that other processes took during a measurement."""

    others: float
    cores: int

    @property
    def busy(self) -> bool:
        """Whether they took more than `BUSY` of the cores."""
        return self.others > BUSY * self.cores

    def to_json(self) -> dict[str, float]:
        """Return ``others_cores`` and ``cores``."""
        return {"others_cores": self.others, "cores": self.cores}

    def __str__(self) -> str:
        said = f"other processes took {self.others:.1f} of {self.cores} cores"
        if not self.busy:
            return said
        return (
            f"the machine was busy: {said}, and more than {BUSY:.0%} moves latencies;"
            " measure again when it is idle"
        )


class OthersLoad:
    """Measure the cores that other processes keep busy while a block runs.

    ``machine`` and ``ours`` return CPU seconds of all processes since boot, and of this
    process with its ended children. ``load`` is None before the end, or if the block
    was too short.
    """

    def __init__(
        self,
        machine: Callable[[], float] | None = None,
        ours: Callable[[], float] | None = None,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._machine, self._ours = machine or _machine_s, ours or cpu_seconds
        self._clock = clock
        self.load: Load | None = None

    def __enter__(self) -> Self:
        self._begun = self._clock(), self._machine(), self._ours()
        return self

    def __exit__(self, *_: object) -> None:
        wall, machine, ours = (
            now - then
            for now, then in zip(
                (self._clock(), self._machine(), self._ours()), self._begun, strict=True
            )
        )
        # A short block is not judged.
        if wall >= SHORTEST_S:
            others = max(0.0, machine - ours) / wall
            self.load = Load(others, os.cpu_count() or 1)


def _machine_s() -> float:
    times = psutil.cpu_times()
    idle = times.idle + getattr(times, "iowait", 0.0)
    guests = getattr(times, "guest", 0.0) + getattr(times, "guest_nice", 0.0)
    return float(sum(times) - idle - guests)  # guests are in user and nice already


def cpu_seconds() -> float:
    """Return the CPU time of this process and of its children that have ended."""
    times = os.times()
    return sum((times.user, times.system, times.children_user, times.children_system))
