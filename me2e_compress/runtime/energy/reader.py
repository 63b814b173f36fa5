"""The interface of an open energy counter, or the reason why there is none."""

import abc
from collections.abc import Mapping
from dataclasses import dataclass, field


@dataclass(frozen=True)
class DeviceState:
    """The state of a device at one moment; unknown values are left out."""

    temperature_c: float | None = None
    clocks_mhz: Mapping[str, float] = field(default_factory=dict)
    throttled: tuple[str, ...] = ()


class Reader(abc.ABC):
    """An open counter that counts energy, or reads power, or both.

    Attributes:
        counter: name of the counter, for the result.
        device: name of the device.
        scope: what is counted: a board, packages, rails.
        step_s: seconds between updates; 0.1, as GPUs have it, where nothing says so.
        counts: whether it counts energy; otherwise its power is integrated.
        tells_power: whether it reads power.
    """

    counter: str
    device: str
    scope: str
    step_s: float = 0.1
    counts: bool = True
    tells_power: bool = False

    def joules(self) -> float:
        """Return the energy since an arbitrary start; called only if ``counts``.

        Raises:
            EnergyError: the counter cannot be read any more, or went back.
        """
        raise NotImplementedError

    def watts(self) -> float:
        """Return the present power; called only if ``tells_power``.

        Raises:
            EnergyError: it cannot be read any more.
        """
        raise NotImplementedError

    def state(self) -> DeviceState:
        """Return the state of the device, as far as it is known."""
        return DeviceState()

    def close(self) -> None:
        """Release what was opened; the default does nothing."""
        return


@dataclass(frozen=True)
class Absent:
    """A counter that is missing or may not be read, with the reason."""

    reason: str
