"""Read NVIDIA's counter of a board's total energy, and its power."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import pynvml

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Absent, DeviceState, Reader

T = TypeVar("T")

_SLOWED = {
    "nvmlClocksEventReasonSwPowerCap": "power cap",
    "nvmlClocksEventReasonHwSlowdown": "hardware slowdown",
    "nvmlClocksEventReasonHwThermalSlowdown": "hardware thermal slowdown",
    "nvmlClocksEventReasonHwPowerBrakeSlowdown": "power brake",
    "nvmlClocksEventReasonSwThermalSlowdown": "thermal slowdown",
}
"""NVML's reasons that reduce speed; idling and clocks set by a user do not count."""


_CLOCKS = {"sm": pynvml.NVML_CLOCK_SM, "memory": pynvml.NVML_CLOCK_MEM}


@dataclass(frozen=True)
class Nvml(EnergyCounter):
    """NVIDIA GPU: total energy (Volta and later), else its power integrated.

    That NVML loads proves nothing: on a Jetson with JetPack 7 it loads, but supports
    neither call. So the calls themselves are tried.

    Attributes:
        index: number of the GPU, 0 or more.
    """

    name: ClassVar[str] = "nvml"
    index: int = 0

    def __post_init__(self) -> None:
        if self.index < 0:
            raise ValueError(f"index {self.index}: must be 0 or more")

    def open(self) -> Reader | Absent:
        """Try the total energy, then the power."""
        try:
            pynvml.nvmlInit()
        except pynvml.NVMLError as error:
            return Absent(str(error))
        reader = self._reader()
        if isinstance(reader, Absent):
            pynvml.nvmlShutdown()
        return reader

    def _reader(self) -> Reader | Absent:
        try:
            handle = pynvml.nvmlDeviceGetHandleByIndex(self.index)
        except pynvml.NVMLError as error:
            return Absent(f"GPU {self.index}: {error}")
        energy = _answer(pynvml.nvmlDeviceGetTotalEnergyConsumption, handle)
        power = _answer(_instant_power, handle)
        if isinstance(energy, str) and isinstance(power, str):
            return Absent(
                f"{_name(handle)} tells no energy: total energy: {energy};"
                f" instant power: {power}"
            )
        return NvmlReader(handle, not isinstance(energy, str), power)


class NvmlReader(Reader):
    """An open GPU; ``power`` is in mW, or the error where it cannot be read."""

    scope = "the whole board"

    def __init__(self, handle: Any, counts: bool, power: int | str) -> None:
        self._handle, self.counts = handle, counts
        self.tells_power = not isinstance(power, str)
        self.counter = "nvml-total" if counts else "nvml-power-integrated"
        self.device = _name(handle)

    def joules(self) -> float:
        """Return the joules since the driver was loaded."""
        return self._ask(pynvml.nvmlDeviceGetTotalEnergyConsumption) / 1e3

    def watts(self) -> float:
        """Return the instantaneous power, not the average of a second."""
        return self._ask(_instant_power) / 1e3

    def state(self) -> DeviceState:
        """Return the temperature, the clocks and the reasons for throttling."""
        degrees = _number(
            pynvml.nvmlDeviceGetTemperature, self._handle, pynvml.NVML_TEMPERATURE_GPU
        )
        clocks = {
            name: _number(pynvml.nvmlDeviceGetClockInfo, self._handle, kind)
            for name, kind in _CLOCKS.items()
        }
        # A bit mask tells why the GPU runs slower.
        mask = _number(pynvml.nvmlDeviceGetCurrentClocksEventReasons, self._handle)
        slowed = tuple(
            words
            for bit, words in _SLOWED.items()
            if mask is not None and int(mask) & getattr(pynvml, bit)
        )
        known = {name: mhz for name, mhz in clocks.items() if mhz is not None}
        return DeviceState(degrees, known, slowed)

    def close(self) -> None:
        """Shut down NVML."""
        pynvml.nvmlShutdown()

    def _ask(self, question: Callable[[Any], int]) -> int:
        found = _answer(question, self._handle)
        if isinstance(found, str):
            raise EnergyError(f"{self.counter} of {self.device}: {found}")
        return found


def _answer(question: Callable[..., T], *arguments: Any) -> T | str:
    """Return NVML's answer, or its error as text."""
    try:
        return question(*arguments)
    except pynvml.NVMLError as error:
        return str(error)


def _number(question: Callable[..., int], *arguments: Any) -> float | None:
    """Return NVML's answer as a number; None on an error."""
    answer = _answer(question, *arguments)
    return None if isinstance(answer, str) else float(answer)


def _instant_power(handle: Any) -> int:
    """Return the present milliwatts; nvmlDeviceGetPowerUsage averages over a second."""
    (found,) = pynvml.nvmlDeviceGetFieldValues(
        handle, [pynvml.NVML_FI_DEV_POWER_INSTANT]
    )
    if found.nvmlReturn != pynvml.NVML_SUCCESS:
        raise pynvml.NVMLError(found.nvmlReturn)
    return int(found.value.uiVal)


def _name(handle: Any) -> str:
    name = _answer(pynvml.nvmlDeviceGetName, handle)
    return name.decode() if isinstance(name, bytes) else str(name)
