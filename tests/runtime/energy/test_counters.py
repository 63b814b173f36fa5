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
from me2e_compress.testing import check_form
from tests.runtime.energy.opened import Driver, reason


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
