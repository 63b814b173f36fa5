"""What a board counts through NVML, and what its driver may lack."""

import pynvml
import pytest

from me2e_compress.errors import EnergyError
from me2e_compress.runtime.energy.nvml import Nvml
from tests.runtime.energy.opened import Driver, answered, reason

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
