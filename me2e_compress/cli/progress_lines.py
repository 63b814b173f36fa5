"""Progress where there is no terminal: a line now and then."""

import time
from collections.abc import Callable

from me2e_compress.display import duration

EVERY_S = 10.0
"""Seconds between two lines."""


class ProgressLines:
    """Writes the progress of a long run, seldom enough for a log.

    A run of less than `EVERY_S` writes nothing, unless every new stage is written too.
    """

    def __init__(
        self,
        write: Callable[[str], None],
        *,
        stages: bool = False,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self._write, self._stages, self._clock = write, stages, clock
        self._stage = ""
        self._begun = self._said = clock()

    def on_progress(self, stage: str, done: int, total: int, what: str) -> None:
        """Write a line if it is time for one; to be called by a listener."""
        now = self._clock()
        if stage != self._stage:
            self._stage, self._begun = stage, now
            if self._stages:
                self._write(stage)
                self._said = now
        if now - self._said < EVERY_S:
            return
        self._said = now
        left = _left(now - self._begun, done, total)
        said = f"{stage}: {done}/{total} {what}".rstrip()
        self._write(", ".join(filter(None, [said, left])))


def _left(seconds: float, done: int, total: int) -> str:
    """Return how long the rest takes at the pace so far; empty if not known."""
    if not 0 < done < total:
        return ""
    return f"{duration(seconds / done * (total - done))} left"
