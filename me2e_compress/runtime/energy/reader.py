"""An open counter of energy, or why there is none."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class DeviceState:
    """How a device is at a moment; what it does not tell is left out.

    Attributes:
        temperature_c: Degrees Celsius; None: not told.
        clocks_mhz: By clock.
        throttled: Reasons for which it slows itself down.
    """

    temperature_c: float | None = None
    clocks_mhz: Mapping[str, float] = field(default_factory=dict)
    throttled: tuple[str, ...] = ()


class Reader(abc.ABC):
    """A counter that answers; it counts energy, or tells power, or both.

    Attributes:
        counter: What counts, for the result.
        device: Its name.
        scope: What is counted: a board, packages, rails.
        step_s: Seconds from one value to the next, where the device says; else None.
        counts: True if it counts energy; else its power is integrated.
        tells_power: True if it tells its power.
    """

    counter: str
    device: str
    scope: str
    step_s: float | None = None
    counts: bool = True
    tells_power: bool = False

    def joules(self) -> float:
        """Return the energy since some moment; asked only if it ``counts``.

        Raises:
            EnergyError: It cannot be read any more, or went back.
        """
        raise NotImplementedError

    def watts(self) -> float:
        """Return the power now; asked only if it ``tells_power``.

        Raises:
            EnergyError: It cannot be read any more.
        """
        raise NotImplementedError

    def state(self) -> DeviceState:
        """Return how the device is; nothing, unless the device can tell."""
        return DeviceState()

    def close(self) -> None:
        """Give back what was opened; nothing, unless overridden."""
        return


@dataclass(frozen=True)
class Absent:
    """A counter that is not there, or may not be read.

    Attributes:
        reason: What it answered.
    """

    reason: str
