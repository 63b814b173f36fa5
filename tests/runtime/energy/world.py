"""A device in a world of its own time: work and sleep take joules, and no time."""

import contextlib
from collections.abc import Callable, Iterator

from me2e_compress.runtime.energy.energy_result import Reader

STEP_S = 0.1


class World(Reader):
    """Its counter moves every step; its power is what it is.

    Attributes:
        now: seconds.
        spent: joules.
        sensed: share of a step, its last part, in which the counter looks.
        drift: share by which the power of work rises in a second.
        readings: of the counter.
    """

    counter, device, scope, step_s = "simulated", "a device", "board", STEP_S

    def __init__(self, idle_w: float = 50.0, sensed: float = 1.0) -> None:
        self.now, self.spent, self.idle_w = 0.03, 0.0, idle_w
        self._shown, self._seen, self._power = 0.0, 0.0, idle_w
        self._next, self._calls = STEP_S, list[tuple[float, Callable[[], None]]]()
        self.readings, self.sensed = 0, sensed
        self.drift = 0.0
        self.worked = list[tuple[str, float]]()

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self._pass(seconds, self.idle_w)

    def model(self, name: str, *parts: float) -> Callable[[], None]:
        """Return what runs a frame: seconds and watts of its parts, in turn."""

        def run() -> None:
            self.worked.append((name, self.now))
            for seconds, watts in zip(parts[::2], parts[1::2], strict=True):
                self._pass(seconds, watts * (1 + self.drift * self.now))

        return run

    @contextlib.contextmanager
    def every(self, period_s: float, call: Callable[[], None]) -> Iterator[None]:
        self._calls.append((period_s, call))
        yield
        self._calls.clear()

    def joules(self) -> float:
        self.readings += 1
        return self._shown

    def watts(self) -> float:
        return self._power

    def throttled(self) -> tuple[str, ...]:
        return ("heat",) if self.now > 10 else ()

    def _pass(self, seconds: float, watts: float) -> None:
        self._power, start, end = watts, self.now, self.now + seconds
        for period, call in self._calls:
            at = (int(start / period) + 1) * period
            while at <= end:
                self.now, at = at, at + period
                call()
        self.now = start
        while self._next <= end:
            self._spend(self._next, watts)
            self._shown += self._seen / self.sensed
            self._seen, self._next = 0.0, self._next + STEP_S
        self._spend(end, watts)

    def _spend(self, until: float, watts: float) -> None:
        looks = max(self.now, self._next - self.sensed * STEP_S)
        self._seen += watts * max(0.0, until - looks)
        self.spent += watts * (until - self.now)
        self.now = until
