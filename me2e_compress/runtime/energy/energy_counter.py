"""Energy counters of devices, and the registry of them.

To add one, write its class and its reader, then add it to this table.
"""

import abc
from collections.abc import Sequence
from dataclasses import dataclass
from typing import ClassVar

from me2e_compress.display import prefixed
from me2e_compress.errors import EnergyError
from me2e_compress.registry import Registry
from me2e_compress.runtime.energy.energy_recording import EnergyRecording
from me2e_compress.runtime.energy.reader import Absent, Reader

__all__ = [
    "ENERGY_COUNTERS",
    "EnergyCounter",
    "check_counter",
    "open_counter",
]

AUTO = "auto"
"""Tries every counter of this machine in turn."""


@dataclass(frozen=True)
class EnergyCounter(abc.ABC):
    """A kind of counter; its fields are its options.

    Class attributes:
        name: its name on the command line.
        automatic: whether ``auto`` may try it.
    """

    name: ClassVar[str]
    automatic: ClassVar[bool] = True

    @abc.abstractmethod
    def open(self) -> Reader | EnergyRecording | Absent:
        """Open the counter and check that it can be read.

        Raises:
            EnergyError: a file that it reads is not usable.
        """


_HERE = "me2e_compress.runtime.energy"

ENERGY_COUNTERS: Registry[EnergyCounter] = Registry(
    "energy counter",
    "me2e_compress.energy_counters",
    EnergyError,
    {
        "nvml": f"{_HERE}.nvml:Nvml",
        "recorded": f"{_HERE}.recorded_energy:Recorded",
    },
)


def open_counter(text: str = AUTO) -> Reader | EnergyRecording | Absent:
    """Open a counter by its text, e.g. ``nvml:1`` or ``recorded:FILE``.

    ``auto`` opens the first of :data:`ENERGY_COUNTERS` that answers on this machine; an
    :class:`Absent` has the answer of each counter tried.

    Raises:
        EnergyError: no such counter, an unknown option, or a file that is not usable.
    """
    if text.strip() != AUTO:
        return _first([ENERGY_COUNTERS.parse(text)])
    kinds = [ENERGY_COUNTERS.get(name) for name in ENERGY_COUNTERS.usable()]
    return _first([ENERGY_COUNTERS.make(kind, {}) for kind in kinds if kind.automatic])


def check_counter(text: str) -> None:
    """Check that a counter's text is valid by opening and closing it.

    A counter that is absent on this machine passes.

    Raises:
        EnergyError: no such counter, an unknown option, or a file that is not usable.
    """
    found = open_counter(text)
    if isinstance(found, Reader):
        found.close()


def _first(counters: Sequence[EnergyCounter]) -> Reader | EnergyRecording | Absent:
    answers = list[str]()
    for each in counters:
        found = each.open()
        if not isinstance(found, Absent):
            return found
        answers.append(prefixed(each.name, found.reason))
    return Absent(f"no energy counter answers ({'; '.join(answers)})")
