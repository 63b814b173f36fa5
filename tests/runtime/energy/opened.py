"""What counters answer when they are opened, and a driver of NVML made up."""

from types import SimpleNamespace

import pynvml
import pytest

from me2e_compress.runtime.energy.energy_result import Absent, Reader


def answered(found: object) -> Reader:
    assert isinstance(found, Reader)
    return found


def reason(found: object) -> str:
    assert isinstance(found, Absent)
    return found.reason


class Driver:
    """What NVML says, call by call; an error code where it does not."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch, **says: int) -> None:
        self.says, self.shut = {"energy": 5_000, "power": 250_000, **says}, 0
        calls = {
            "nvmlInit": lambda: self.answer("init"),
            "nvmlShutdown": self.shutdown,
            "nvmlDeviceGetHandleByIndex": lambda index: self.answer("gpu", index),
            "nvmlDeviceGetName": lambda handle: "A GPU",
            "nvmlDeviceGetTotalEnergyConsumption": lambda handle: self.answer("energy"),
            "nvmlDeviceGetFieldValues": lambda handle, fields: [self.field()],
            "nvmlDeviceGetCurrentClocksEventReasons": lambda handle: self.answer(
                "slow"
            ),
        }
        for name, call in calls.items():
            monkeypatch.setattr(pynvml, name, call)

    def shutdown(self) -> None:
        self.shut += 1

    def answer(self, what: str, usual: int = 0) -> int:
        found = self.says.get(what, usual)
        if found < 0:
            raise pynvml.NVMLError(-found)
        return found

    def field(self) -> SimpleNamespace:
        power = self.says["power"]
        code, milliwatts = (-power, 0) if power < 0 else (0, power)
        return SimpleNamespace(nvmlReturn=code, value=SimpleNamespace(uiVal=milliwatts))
