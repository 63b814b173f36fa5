"""Read NVIDIA's counter of a board's total energy, and its power."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, ClassVar, TypeVar

import pynvml

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Absent, Reader

T = TypeVar("T")

# NVML's reasons that reduce speed; idling and clocks set by a user do not count
_REASONS = {
    "nvmlClocksEventReasonSwPowerCap": "power cap",
    "nvmlClocksEventReasonHwSlowdown": "hardware slowdown",
    "nvmlClocksEventReasonHwThermalSlowdown": "hardware thermal slowdown",
    "nvmlClocksEventReasonHwPowerBrakeSlowdown": "power brake",
    "nvmlClocksEventReasonSwThermalSlowdown": "thermal slowdown",
}


@dataclass(frozen=True)
class Nvml(EnergyCounter):
    """NVIDIA GPU: total energy (Volta and later), else its power integrated.

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
        # That NVML loads proves nothing: on a Jetson with JetPack 7 it loads, but
        # supports neither call
        energy = _query(pynvml.nvmlDeviceGetTotalEnergyConsumption, handle)
        power = _query(_instant_power, handle)
        if isinstance(energy, str) and isinstance(power, str):
            return Absent(
                f"{_device_name(handle)} tells no energy: total energy: {energy};"
                f" instant power: {power}"
            )
        return NvmlReader(handle, not isinstance(energy, str))


class NvmlReader(Reader):
    """An open GPU, which counts energy or else reads power."""

    scope = "the whole board"

    def __init__(self, handle: Any, counts: bool) -> None:
        self._handle, self.counts = handle, counts
        self.counter = "nvml-total" if counts else "nvml-power-integrated"
        self.device = _device_name(handle)

    def joules(self) -> float:
        """Return the joules since the driver was loaded."""
        return self._ask(pynvml.nvmlDeviceGetTotalEnergyConsumption) / 1e3

    def watts(self) -> float:
        """Return the instantaneous power, not the average of a second."""
        return self._ask(_instant_power) / 1e3

    def throttled(self) -> tuple[str, ...]:
        """Return why the GPU runs slower, of a bit mask; empty if it does not say."""
        mask = _query(pynvml.nvmlDeviceGetCurrentClocksEventReasons, self._handle)
        if isinstance(mask, str):
            return ()
        return tuple(
            words for bit, words in _REASONS.items() if mask & getattr(pynvml, bit)
        )

    def close(self) -> None:
        """Shut down NVML."""
        pynvml.nvmlShutdown()

    def _ask(self, question: Callable[[Any], int]) -> int:
        answer = _query(question, self._handle)
        if isinstance(answer, str):
            raise EnergyError(f"{self.counter} of {self.device}: {answer}")
        return answer


def _query(question: Callable[..., T], *arguments: Any) -> T | str:
    """Return NVML's answer, or its error as text."""
    try:
        return question(*arguments)
    except pynvml.NVMLError as error:
        return str(error)


def _instant_power(handle: Any) -> int:
    """Return the present milliwatts; nvmlDeviceGetPowerUsage averages over a second."""
    (field,) = pynvml.nvmlDeviceGetFieldValues(
        handle, [pynvml.NVML_FI_DEV_POWER_INSTANT]
    )
    if field.nvmlReturn != pynvml.NVML_SUCCESS:
        raise pynvml.NVMLError(field.nvmlReturn)
    return int(field.value.uiVal)


def _device_name(handle: Any) -> str:
    name = _query(pynvml.nvmlDeviceGetName, handle)
    return name.decode() if isinstance(name, bytes) else str(name)
