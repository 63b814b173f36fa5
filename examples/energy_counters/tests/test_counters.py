"""The counters answer in joules or watts, or say why not; run with pytest, alone."""

from pathlib import Path

import pytest

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import ENERGY_COUNTERS
from me2e_compress.runtime.energy.energy_result import Absent, Reader
from me2e_compress.testing import check_form
from me2e_counters.ina3221 import Ina3221, counted
from me2e_counters.rapl import Rapl


def answered(found: object) -> Reader:
    assert isinstance(found, Reader)
    return found


def reason(found: object) -> str:
    assert isinstance(found, Absent)
    return found.reason


@pytest.mark.parametrize("text", ["ina3221", "rapl"])
def test_both_are_found_once_installed(text: str) -> None:
    check_form(ENERGY_COUNTERS.parse(text), ENERGY_COUNTERS)


RANGE = 1_000_000


def zone(root: Path, folder: str, name: str, energy: str = "0") -> Path:
    place = root / folder
    place.mkdir(parents=True)
    (place / "name").write_text(f"{name}\n")
    (place / "energy_uj").write_text(energy)
    (place / "max_energy_range_uj").write_text(str(RANGE))
    return place / "energy_uj"


def test_packages_and_memory_are_added_up_and_parts_are_not(tmp_path: Path) -> None:
    zones = [
        zone(tmp_path, "intel-rapl:0", "package-0"),
        zone(tmp_path, "intel-rapl:1", "package-1"),
        zone(tmp_path, "intel-rapl:0:2", "dram"),
        zone(tmp_path, "intel-rapl:0:0", "core"),
        zone(tmp_path, "intel-rapl:2", "psys"),
        zone(tmp_path, "intel-rapl-mmio:0", "package-0"),
    ]
    reader = answered(Rapl(tmp_path).open())
    for each in zones:
        each.write_text("100000")

    assert reader.joules() == pytest.approx(0.3)
    assert reader.scope == "package-0 + dram + package-1"


def test_a_range_that_is_passed_is_no_step_back(tmp_path: Path) -> None:
    energy = zone(tmp_path, "intel-rapl:0", "package-0", str(RANGE - 1000))
    reader = answered(Rapl(tmp_path).open())
    energy.write_text("2000")

    assert reader.joules() == pytest.approx(3000e-6)


def test_a_step_back_is_no_range_that_is_passed(tmp_path: Path) -> None:
    energy = zone(tmp_path, "intel-rapl:0", "package-0", "500000")
    reader = answered(Rapl(tmp_path).open())
    energy.write_text("400000")

    with pytest.raises(EnergyError, match="rapl package-0 went back from 500000"):
        reader.joules()


def test_a_counter_that_vanishes_is_an_error(tmp_path: Path) -> None:
    energy = zone(tmp_path, "intel-rapl:0", "package-0")
    reader = answered(Rapl(tmp_path).open())
    energy.unlink()

    with pytest.raises(EnergyError, match=r"rapl package-0: .*energy_uj"):
        reader.joules()


def test_what_may_not_be_read_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    energy = zone(tmp_path, "intel-rapl:0", "package-0")
    read = Path.read_text

    def refused(path: Path, *args: str) -> str:
        if path == energy:  # root may read it whatever its mode
            raise PermissionError(13, "Permission denied", str(path))
        return read(path, *args)

    monkeypatch.setattr(Path, "read_text", refused)

    found = reason(Rapl(tmp_path).open())
    assert f"{energy} may not be read: permission denied" in found


@pytest.mark.parametrize(
    ("folder", "name"), [("intel-rapl:0", "psys"), ("dtpm", "dtpm")]
)
def test_no_package(folder: str, name: str, tmp_path: Path) -> None:
    zone(tmp_path, folder, name)

    assert "no package in" in reason(Rapl(tmp_path).open())


def jetson(root: Path, rails: dict[str, tuple[int, int]]) -> Path:
    sensor = root / "ina3221" / "1-0040" / "hwmon" / "hwmon3"
    sensor.mkdir(parents=True)
    for number, (label, (millivolts, milliamperes)) in enumerate(rails.items(), 1):
        (sensor / f"in{number}_label").write_text(f"{label}\n")
        (sensor / f"in{number}_input").write_text(str(millivolts))
        (sensor / f"curr{number}_input").write_text(str(milliamperes))
    (sensor / "samples").write_text("64")
    (sensor / "update_interval").write_text("20")
    return sensor


def test_the_input_rail_is_not_added_to_its_children(tmp_path: Path) -> None:
    rails = {"VDD_IN": (5000, 2000), "VDD_CPU_GPU_CV": (5000, 900), "VDD_SOC": (1, 1)}
    jetson(tmp_path, rails)
    reader = answered(Ina3221(root=tmp_path).open())

    assert reader.watts() == pytest.approx(10.0)
    assert reader.scope == "VDD_IN (samples 64, update_interval 20)"
    assert reader.step_s == pytest.approx(0.02)
    assert not reader.counts


def test_rails_without_an_input_are_added_up_once(tmp_path: Path) -> None:
    rails = {"VDD_GPU_SOC": (5000, 2000), "NC": (5000, 900), "VIN_SYS_5V0": (5000, 1)}
    jetson(tmp_path, rails)

    assert answered(Ina3221(root=tmp_path).open()).watts() == pytest.approx(10.005)
    orin = ["VDD_GPU_SOC", "VDD_CPU_CV", "VIN_SYS_5V0", "VDDQ_VDD2_1V8AO"]
    assert counted(orin) == orin[:3]


def test_rails_may_be_named(tmp_path: Path) -> None:
    jetson(tmp_path, {"VDD_IN": (5000, 2000), "VDD_SOC": (5000, 100)})
    named = Ina3221(("VDD_SOC",), tmp_path)

    assert answered(named.open()).watts() == pytest.approx(0.5)
    assert reason(Ina3221(("GPU",), tmp_path).open()) == (
        "no rail GPU; there are VDD_IN, VDD_SOC"
    )


def test_a_rail_that_says_nothing_is_the_answer(tmp_path: Path) -> None:
    sensor = jetson(tmp_path, {"VDD_IN": (5000, 2000)})
    (sensor / "curr1_input").write_text("")

    assert "invalid literal" in reason(Ina3221(root=tmp_path).open())
