"""A device in a world of its own time: work and sleep take joules, and no time."""

import contextlib
from collections.abc import Callable, Iterator

from me2e_compress.runtime.energy.reader import DeviceState, Reader


class World(Reader):
    """Its counter moves every step; its power is what it is.

    Attributes:
        now: seconds.
        spent: joules.
        readings: of the counter.
    """

    counter, device, scope = "simulated", "a device", "board"

    def __init__(
        self, step_s: float = 0.1, idle_w: float = 50.0, tells_power: bool = False
    ) -> None:
        self.now, self.spent, self.idle_w = 0.03, 0.0, idle_w
        self._ticks_s, self._shown, self._power = step_s, 0.0, idle_w
        self._next, self._calls = step_s, list[tuple[float, Callable[[], None]]]()
        self.tells_power, self.readings = tells_power, 0
        self.power_factor = 1.0
        self.worked = list[tuple[str, float]]()

    def clock(self) -> float:
        return self.now

    def sleep(self, seconds: float) -> None:
        self._pass(seconds, self.idle_w)

    def model(self, name: str, frame_s: float, watts: float) -> Callable[[], None]:
        def run() -> None:
            self.worked.append((name, self.now))
            self._pass(frame_s, watts)

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
        return self._power * self.power_factor

    def state(self) -> DeviceState:
        return DeviceState(40 + self.now / 60, {"sm": 1_000 + self.now})

    def _pass(self, seconds: float, watts: float) -> None:
        self._power, end = watts, self.now + seconds
        moments = [self._next]
        for period, call in self._calls:  # before the time moves on
            at = (int(self.now / period) + 1) * period
            while at <= end:
                self.now, at = at, at + period
                call()
        self.now = end - seconds
        while moments[-1] <= end:
            self.spent += watts * (moments[-1] - self.now)
            self.now, self._shown = moments[-1], self.spent
            moments.append(moments[-1] + self._ticks_s)
        self.spent += watts * (end - self.now)
        self.now, self._next = end, moments[-1]
