"""Read the power rails of a Jetson: INA3221 sensors under sysfs."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Absent, Reader
from me2e_counters import text_in

INPUTS = ("VDD_IN", "POM_5V_IN")
"""Rails that feed the module (Xavier NX, Orin NX and Nano, TX2; Nano). All others
branch from them; adding those would count them twice (jetson_stats, issue 51)."""
CONTAINED = {"VDDQ_VDD2_1V8AO": "VIN_SYS_5V0"}
"""Rails that another rail includes (Jetson AGX Orin, NVIDIA's developer guide)."""


@dataclass(frozen=True)
class Channel:
    """One rail of a sensor, with the files of its voltage and current."""

    label: str
    millivolts: Path
    milliamperes: Path

    def watts(self) -> float:
        """Return the present power; OSError or ValueError if a file has no number."""
        volts, amperes = self.millivolts.read_text(), self.milliamperes.read_text()
        return int(volts) * int(amperes) / 1e6


@dataclass(frozen=True)
class Ina3221(EnergyCounter):
    """Jetson: the rail that feeds the module; without one, the sum of its rails.

    Attributes:
        rails: labels of the rails to add up; empty chooses as described above.
        root: folder of the drivers of I2C devices.
    """

    name: ClassVar[str] = "ina3221"
    rails: tuple[str, ...] = ()
    root: Path = Path("/sys/bus/i2c/drivers")

    def open(self) -> Reader | Absent:
        """Open the rails, each counted once."""
        sensors = sorted(self.root.glob("ina3221*/*/hwmon/hwmon*"))
        if not sensors:
            return Absent(f"no {self.root}/ina3221")
        found = [each for sensor in sensors for each in _channels(sensor)]
        labels = [each.label for each in found]
        if lacking := [label for label in self.rails if label not in labels]:
            there = ", ".join(labels) or "none"
            return Absent(f"no rail {lacking[0]}; there are {there}")
        # Choose rails so that none is counted twice.
        wanted = self.rails or counted(labels)
        chosen = [each for each in found if each.label in wanted]
        if not chosen:
            return Absent(
                f"{sensors[0]}: no rail with a label, a voltage and a current"
            )
        # Read each once, so that missing permissions show now.
        try:
            for each in chosen:
                each.watts()
        except PermissionError as error:
            return Absent(f"{error.filename} may not be read: permission denied")
        except (OSError, ValueError) as error:
            return Absent(str(error))
        return Ina3221Reader(chosen, sensors)


class Ina3221Reader(Reader):
    """Open rails, whose power is integrated."""

    counter = "ina3221-integrated"
    counts = False

    def __init__(self, channels: Sequence[Channel], sensors: Sequence[Path]) -> None:
        self._channels = channels
        self.device = "Jetson"
        # The scope tells how the sensor averages its power.
        averaging = ", ".join(
            f"{name} {text}"
            for name in ("samples", "update_interval")
            if (text := text_in(sensors[0] / name))
        )
        rails = " + ".join(each.label for each in channels)
        self.scope = f"{rails} ({averaging})" if averaging else rails
        self.step_s = _seconds(text_in(sensors[0] / "update_interval")) or self.step_s

    def watts(self) -> float:
        """Return the summed power of the chosen rails."""
        try:
            return sum(each.watts() for each in self._channels)
        except (OSError, ValueError) as error:
            raise EnergyError(f"ina3221: {error}") from error


def counted(labels: Sequence[str]) -> list[str]:
    """Return the rails to add up, none of which is part of another."""
    inputs = [label for label in labels if label in INPUTS]
    if inputs:
        return inputs[:1]
    return [label for label in labels if CONTAINED.get(label) not in labels]


def _channels(sensor: Path) -> list[Channel]:
    """List the rails of a sensor; one without a name is not connected."""
    return [
        Channel(label, sensor / f"in{number}_input", sensor / f"curr{number}_input")
        for number in (1, 2, 3)
        if (label := text_in(sensor / f"in{number}_label")) not in ("", "NC")
        and (sensor / f"curr{number}_input").exists()
    ]


def _seconds(milliseconds: str) -> float | None:
    try:
        return int(milliseconds) / 1e3 or None
    except ValueError:
        return None
