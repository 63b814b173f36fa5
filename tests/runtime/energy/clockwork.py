"""A counter that another package could bring: ten watts, whatever happens."""

import time
from dataclasses import dataclass
from typing import ClassVar

from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Reader


@dataclass(frozen=True)
class Clockwork(EnergyCounter):
    """Counts seconds and says that they are joules.

    Attributes:
        watts: at which they pass.
    """

    name: ClassVar[str] = "clockwork"
    automatic: ClassVar[bool] = False
    watts: float = 10.0

    def open(self) -> Reader:
        """Wind it up."""
        return Clock(self.watts)


class Clock(Reader):
    counter, device, scope, step_s = "clockwork", "a clock", "its spring", 1e-6
    closed = 0

    def __init__(self, watts: float) -> None:
        self._watts = watts

    def joules(self) -> float:
        return self._watts * time.perf_counter()

    def close(self) -> None:
        type(self).closed += 1
