"""Counters are found by asking them: they answer in joules, or say why not."""

from dataclasses import dataclass, replace
from typing import ClassVar

import pynvml
import pytest

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy import energy_counter
from me2e_compress.runtime.energy.energy_counter import (
    ENERGY_COUNTERS,
    EnergyCounter,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import Absent
from me2e_compress.runtime.energy.nvml import Nvml
from me2e_compress.testing import check_form
from tests.runtime.energy.opened import Driver, answered, reason


def test_no_counter_lists_what_each_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    Driver(monkeypatch, init=-pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)

    assert reason(open_counter()) == (
        "no energy counter answers (nvml: NVML Shared Library Not Found)"
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("watts", "no energy counter 'watts'; there are nvml, recorded"),
        ("rapl", "rapl is gone since 0.3.0: use examples/energy_counters"),
        ("nvml:-1", "nvml: index -1"),
        ("nvml{size=1}", "nvml has no option 'size'"),
        ("recorded", "recorded needs the option file"),
    ],
)
def test_a_counter_that_is_none(text: str, fault: str) -> None:
    with pytest.raises(EnergyError, match=fault):
        open_counter(text)


@pytest.mark.parametrize("text", ["nvml:1", "recorded:r.csv"])
def test_ours_hold(text: str) -> None:
    check_form(ENERGY_COUNTERS.parse(text), ENERGY_COUNTERS)


@dataclass(frozen=True)
class Battery(EnergyCounter):
    name: ClassVar[str] = "battery"

    def open(self) -> Absent:
        return Absent("battery: none in this machine")


def test_a_counter_is_named_once(monkeypatch: pytest.MonkeyPatch) -> None:
    here = {"battery": f"{__name__}:Battery"}
    monkeypatch.setattr(
        energy_counter, "ENERGY_COUNTERS", replace(ENERGY_COUNTERS, builtin=here)
    )

    assert reason(open_counter("battery")) == (
        "no energy counter answers (battery: none in this machine)"
    )


# What a board counts through NVML, and what its driver may lack.


UNSUPPORTED = -pynvml.NVML_ERROR_NOT_SUPPORTED


def test_a_board_counts_and_tells_its_power(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch, slow=pynvml.nvmlClocksEventReasonSwPowerCap)
    reader = answered(Nvml().open())

    assert (reader.counter, reader.device) == ("nvml-total", "A GPU")
    assert (reader.joules(), reader.watts()) == (5.0, 250.0)
    assert reader.state().temperature_c == 61
    assert reader.state().clocks_mhz == {"sm": 1_700, "memory": 1_700}
    assert reader.state().throttled == ("power cap",)
    reader.close()
    assert driver.shut == 1


def test_a_card_without_a_counter_has_its_power_integrated(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Driver(monkeypatch, energy=UNSUPPORTED)
    reader = answered(Nvml().open())

    assert (reader.counter, reader.counts) == ("nvml-power-integrated", False)


def test_a_counter_without_power_beside_it(monkeypatch: pytest.MonkeyPatch) -> None:
    Driver(monkeypatch, power=UNSUPPORTED, clock=UNSUPPORTED, slow=UNSUPPORTED)
    reader = answered(Nvml().open())

    assert (reader.counts, reader.tells_power) == (True, False)
    assert reader.state().clocks_mhz == {}


def test_a_driver_that_answers_and_supports_nothing(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    driver = Driver(monkeypatch, energy=UNSUPPORTED, power=UNSUPPORTED)

    assert reason(Nvml().open()) == (
        "A GPU tells no energy: total energy: Not Supported;"
        " instant power: Not Supported"
    )
    assert driver.shut == 1


@pytest.mark.parametrize("what", ["init", "gpu"])
def test_no_driver_or_no_such_gpu(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    Driver(monkeypatch, **{what: -pynvml.NVML_ERROR_NOT_FOUND})

    assert "Not Found" in reason(Nvml(1).open())


def test_a_gpu_that_is_lost_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch)
    reader = answered(Nvml().open())
    driver.says["energy"] = -pynvml.NVML_ERROR_GPU_IS_LOST

    with pytest.raises(EnergyError, match="nvml-total of A GPU: GPU is lost"):
        reader.joules()
