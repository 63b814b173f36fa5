"""What was measured is written, read back and shown; what was not has a reason."""

import json
import math
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import ClassVar

import numpy as np
import pynvml
import pytest
from scipy import stats

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy import EnergyResult, energy_counter
from me2e_compress.runtime.energy.energy_counter import (
    ENERGY_COUNTERS,
    EnergyCounter,
    open_counter,
)
from me2e_compress.runtime.energy.energy_result import (
    Absent,
    Window,
    estimate,
    summarise,
)
from me2e_compress.runtime.energy.nvml import Nvml
from me2e_compress.testing import check_form
from tests.runtime.energy.opened import Driver, answered, reason

NONE = EnergyResult(reason="no energy counter answers")
FOUND = EnergyResult(
    joules=2_000.0,
    frames=800,
    j_per_frame=2.5,
    net_j_per_frame=2.0,
    low=2.4,
    high=2.6,
    windows=8,
    window_s=10.0,
    counter="nvml-total",
    counter_step_s=0.1,
    idle_w=50.0,
    device="a GPU",
    scope="board",
    model_sha256="0",
    window_j_per_frame=(2.5,) * 8,
)


@pytest.mark.parametrize("result", [NONE, FOUND])
def test_what_is_saved_is_read_back(result: EnergyResult, tmp_path: Path) -> None:
    result.save(tmp_path / "energy.json")

    assert EnergyResult.load(tmp_path / "energy.json") == result


def test_a_figure_stands_beside_its_interval_or_a_reason_in_its_place() -> None:
    assert NONE.headline == f"energy: not measured: {NONE.reason}"
    assert NONE.tables() == ()
    assert FOUND.headline == "energy: 2.5 J a frame (2.4 to 2.6), nvml-total of a GPU"
    (shown,) = FOUND.tables()
    assert [cell.text for cell in shown.rows[0]] == ["gross", "2.5", "2.4", "2.6"]
    assert "idle 50 W" in shown.note
    assert FOUND.alerts() == ()
    (line,) = replace(FOUND, throttled=("power cap",)).alerts()
    assert "slowed itself down: power cap" in line


@pytest.mark.parametrize(
    ("change", "fault"),
    [
        ({"j_per_frame": None}, "neither joules a frame nor a reason"),
        ({"reason": "none"}, "both joules a frame and a reason"),
        ({"low": None}, "low and high go with j_per_frame"),
        ({"low": 2.55}, "does not hold j_per_frame"),
        ({"joules": -1.0}, "greater than or equal to 0"),
        ({"frames": "many"}, "frames: "),
    ],
)
def test_a_file_that_contradicts_itself_is_one_line(
    change: dict[str, object], fault: str, tmp_path: Path
) -> None:
    path = tmp_path / "energy.json"
    path.write_text(json.dumps({**asdict(FOUND), **change}))

    with pytest.raises(EnergyError, match=fault) as caught:
        EnergyResult.load(path)
    assert "\n" not in str(caught.value)


BY = ("nvml-total", "a GPU", "board", 0.1)


WINDOWS = [Window(10.0 * at, 10.0 * at + 10.0, 20, 200.0) for at in range(5)]
"""Five windows of 10 s, 20 frames and 200 J."""


def test_an_idle_device_is_taken_off() -> None:
    found = summarise(WINDOWS, BY, 6.0, ["heat", "power cap", "heat"])

    assert found.j_per_frame == pytest.approx(10.0)
    assert found.net_j_per_frame == pytest.approx(10.0 - 6.0 * 10 / 20)
    assert found.throttled == ("heat", "power cap")
    assert summarise(WINDOWS, BY, None).net_j_per_frame is None


# The interval is Student's over windows, with what the counter's step allows.


def windows(*joules: float, length: float = 10.0) -> list[Window]:
    """Windows of ten frames, one behind the other."""
    return [
        Window(at * length, (at + 1) * length, 10, each)
        for at, each in enumerate(joules)
    ]


@pytest.mark.parametrize(
    ("length", "beyond"),
    [(10.0, 0.002), (10.05, 0.05)],  # the step is unsure: 2 ms of 10 s
)
def test_windows_that_agree_are_as_sure_as_the_step_is(
    length: float, beyond: float
) -> None:
    _, low, high = estimate(windows(*[10 * length] * 5, length=length), step_s=0.1)

    # power x sqrt(r (step - r)), a frame
    ends = 10.0 / 10 * math.sqrt(beyond * (0.1 - beyond))
    half = stats.t.ppf(0.975, 3) * ends / math.sqrt(5)
    assert high - low == pytest.approx(2 * half, rel=1e-6)


def test_a_drift_in_a_line_is_no_noise() -> None:
    mean, low, high = estimate(windows(98, 99, 100, 101, 102), step_s=1e-9)

    assert mean == pytest.approx(10.0)
    assert high - low == pytest.approx(0.0, abs=1e-6)


def test_what_is_left_of_the_line_is_the_spread() -> None:
    drawn = np.random.default_rng(0).normal(100, 1, 6)
    _, low, high = estimate(windows(*drawn), step_s=0.1)

    line = stats.linregress(np.arange(6), drawn / 10)
    left = drawn / 10 - line.intercept - line.slope * np.arange(6)
    half = stats.t.ppf(0.975, 4) * math.sqrt(left @ left / 4 / 6)
    assert high - low == pytest.approx(2 * half, rel=1e-3)


# Counters are found by asking them: they answer in joules, or say why not.


def test_no_counter_lists_what_each_answered(monkeypatch: pytest.MonkeyPatch) -> None:
    Driver(monkeypatch, init=-pynvml.NVML_ERROR_LIBRARY_NOT_FOUND)

    assert reason(open_counter()) == (
        "no energy counter answers (nvml: NVML Shared Library Not Found)"
    )


@pytest.mark.parametrize(
    ("text", "fault"),
    [
        ("watts", "no energy counter 'watts'; there are nvml, recorded"),
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


UNSUPPORTED = -pynvml.NVML_ERROR_NOT_SUPPORTED


def test_a_board_counts_and_tells_its_power(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch, slow=pynvml.nvmlClocksEventReasonSwPowerCap)
    reader = answered(Nvml().open())

    assert (reader.counter, reader.device) == ("nvml-total", "A GPU")
    assert (reader.joules(), reader.watts()) == (5.0, 250.0)
    assert reader.throttled() == ("power cap",)
    reader.close()
    assert driver.shut == 1


def test_a_counter_without_power_beside_it_and_power_without_a_counter(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    Driver(monkeypatch, energy=UNSUPPORTED)
    reader = answered(Nvml().open())
    assert (reader.counter, reader.counts) == ("nvml-power-integrated", False)

    Driver(monkeypatch, power=UNSUPPORTED, slow=UNSUPPORTED)
    reader = answered(Nvml().open())

    assert reader.counts
    assert reader.throttled() == ()


LOST = {"energy": UNSUPPORTED, "power": UNSUPPORTED}
NOT_FOUND = -pynvml.NVML_ERROR_NOT_FOUND


@pytest.mark.parametrize(
    ("says", "why", "shut"),
    [
        (LOST, "no energy: total energy: Not Supported; instant power: Not Supp", 1),
        ({"init": NOT_FOUND}, "Not Found", 0),
        ({"gpu": NOT_FOUND}, "Not Found", 1),
    ],
)
def test_a_driver_that_is_not_there_or_supports_nothing(
    says: dict[str, int], why: str, shut: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    driver = Driver(monkeypatch, **says)

    assert why in reason(Nvml(1).open())
    assert driver.shut == shut


def test_a_gpu_that_is_lost_is_an_error(monkeypatch: pytest.MonkeyPatch) -> None:
    driver = Driver(monkeypatch)
    reader = answered(Nvml().open())
    driver.says["energy"] = -pynvml.NVML_ERROR_GPU_IS_LOST

    with pytest.raises(EnergyError, match="nvml-total of A GPU: GPU is lost"):
        reader.joules()
