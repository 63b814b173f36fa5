"""Read the energy counters of processors from Linux's powercap interface (RAPL)."""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import ClassVar

from me2e_compress.base.errors import EnergyError
from me2e_compress.runtime.energy.energy_counter import EnergyCounter
from me2e_compress.runtime.energy.energy_result import Absent, Reader
from me2e_compress.runtime.profile import processor
from me2e_counters import text_in

_COUNTED = ("package", "dram")
"""Prefixes of the zone names to add up. ``core`` and ``uncore`` are parts of a package,
``psys`` includes the packages; ``dram`` is separate."""


@dataclass(frozen=True)
class Rapl(EnergyCounter):
    """Processor: packages and, where it is counted, memory; Intel and AMD.

    Attributes:
        root: folder of the powercap classes.
    """

    name: ClassVar[str] = "rapl"
    root: Path = Path("/sys/class/powercap")

    def open(self) -> Reader | Absent:
        """Read every zone once: only root may, since CVE-2020-8694."""
        if not self.root.is_dir():
            return Absent(f"no {self.root}")
        # Take the packages and the memory, not their parts.
        zones = {
            zone: name
            for zone in sorted(self.root.glob("intel-rapl:*"))
            if (name := text_in(zone / "name")) and name.startswith(_COUNTED)
        }
        if not any(name.startswith("package") for name in zones.values()):
            return Absent(f"no package in {self.root}")
        # Opening reads every counter once.
        try:
            return RaplReader(zones)
        except PermissionError as error:
            return Absent(
                f"{error.filename} may not be read: permission denied"
                " (run as root, or let root chmod a+r it)"
            )
        except (OSError, ValueError) as error:
            return Absent(f"{self.root}: {error}")


class RaplReader(Reader):
    """Open zones, given as folders with their names."""

    counter = "rapl"
    step_s = 1e-3
    """Intel updates every millisecond (Software Developer's Manual 3B, 16.10)."""

    def __init__(self, zones: Mapping[Path, str]) -> None:
        self.device, self.scope = processor(), " + ".join(zones.values())
        self._zones = [_Zone(folder, name) for folder, name in zones.items()]

    def joules(self) -> float:
        """Return the joules since opening, corrected for wrap-arounds."""
        return sum(zone.moved_uj() for zone in self._zones) / 1e6


class _Zone:
    """One counter in microjoules that wraps around at its range."""

    def __init__(self, folder: Path, name: str) -> None:
        self._file, self._name = folder / "energy_uj", name
        self._range = int((folder / "max_energy_range_uj").read_text())
        self._last, self._moved = int(self._file.read_text()), 0

    def moved_uj(self) -> int:
        try:
            now = int(self._file.read_text())
        except (OSError, ValueError) as error:
            raise EnergyError(f"rapl {self._name}: {self._file}: {error}") from error
        step = now - self._last
        if step < 0:
            step += self._range
            # Windows take seconds, a range minutes: half of one in one go is no wrap.
            if not 0 <= step < self._range / 2:
                raise EnergyError(
                    f"rapl {self._name} went back from {self._last} to {now} uJ:"
                    f" no wrap-around, its range is {self._range} uJ"
                )
        self._last, self._moved = now, self._moved + step
        return self._moved
