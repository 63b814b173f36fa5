"""A power meter at the plug, whose logger keeps its last reading in a file."""

from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Absent, Reader


@dataclass(frozen=True)
class WallMeter(EnergyCounter):
    """The whole machine, measured at the plug.

    Attributes:
        file: where the logger writes the watts, again and again.
    """

    name: ClassVar[str] = "wall-meter"
    automatic: ClassVar[bool] = False
    file: Path = Path("/run/wall-meter/watts")

    def open(self) -> Reader | Absent:
        """Read the file once: what cannot be read now is not there."""
        reader = WallReader(self.file)
        try:
            reader.watts()
        except EnergyError as error:
            return Absent(str(error))
        return reader


class WallReader(Reader):
    """Its power is integrated; it counts nothing itself."""

    counter, device, scope = "wall-meter", "this machine", "all of it, at the plug"
    counts, step_s = False, 0.5

    def __init__(self, file: Path) -> None:
        self._file = file

    def watts(self) -> float:
        """Return the last reading."""
        try:
            return float(self._file.read_text())
        except (OSError, ValueError) as error:
            raise EnergyError(f"wall-meter: {self._file}: {error}") from error
