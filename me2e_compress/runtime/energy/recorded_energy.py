"""Read an energy recording made on the target device, as CSV or JSON."""

import csv
import io
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from me2e_compress.errors import EnergyError
from me2e_compress.registry import documents
from me2e_compress.runtime.energy.energy_counter import EnergyCounter, EnergyRecording
from me2e_compress.runtime.energy.meter import Floats, integrated

_COLUMNS = "time_s, frames, and joules or watts"


@dataclass(frozen=True)
class Recorded(EnergyCounter):
    """A file of the energy or the power that was recorded on the target device.

    CSV with a header, or JSON with an array for each column: ``time_s``, ``frames``
    (inferences done so far), and ``joules`` (so far) or ``watts`` (at that time). JSON
    may add the texts ``device``, ``scope`` and ``counter``.

    Attributes:
        file: the recording.
    """

    name: ClassVar[str] = "recorded"
    automatic: ClassVar[bool] = False
    file: Path

    def open(self) -> EnergyRecording:
        """Read the file and check it."""
        try:
            columns, words = _read(self.file)
            return _recording(columns, words, self.file.name)
        except OSError as error:
            raise EnergyError(f"{self.file}: {error.strerror}") from error
        except (documents.MalformedError, ValueError, TypeError, csv.Error) as error:
            raise EnergyError(
                f"{self.file}: not an energy recording: {error}"
            ) from error


def _read(path: Path) -> tuple[Mapping[str, Sequence[Any]], Mapping[str, str]]:
    """Return the columns, and the texts that describe the device."""
    content = documents.content(path)
    # JSON: arrays are columns, texts describe the device.
    if path.suffix.lower() == ".json":
        record = documents.from_json(content)
        if not isinstance(record, dict):
            raise ValueError(f"an object with {_COLUMNS} is expected")
        columns = {k: v for k, v in record.items() if isinstance(v, list)}
        return columns, {k: v for k, v in record.items() if isinstance(v, str)}
    # CSV: every row must have as many values as the header.
    rows = csv.reader(io.StringIO(content.decode("utf-8-sig")))
    header = [name.strip() for name in next(rows, [])]
    lines = [line for line in rows if line]
    for number, line in enumerate(lines, 2):
        if len(line) != len(header):
            raise ValueError(
                f"line {number} has {len(line)} values, the header {len(header)}"
            )
    values = zip(*lines, strict=True) if lines else [()] * len(header)
    return dict(zip(header, values, strict=True)), {}


def _recording(
    columns: Mapping[str, Sequence[Any]], words: Mapping[str, str], name: str
) -> EnergyRecording:
    times, frames = _numbers(columns, "time_s"), _numbers(columns, "frames")
    if np.any(np.diff(times) <= 0):
        raise ValueError(f"time_s does not ascend at row {_first(np.diff(times) <= 0)}")
    if np.any(np.diff(frames) < 0):
        raise ValueError(f"frames go back at row {_first(np.diff(frames) < 0)}")
    # Check the columns against each other.
    counts = "joules" in columns
    found = _numbers(columns, "joules" if counts else "watts")
    if len({len(times), len(frames), len(found)}) > 1 or len(times) < 2:
        raise ValueError("the columns are not of one length of 2 rows or more")
    if counts and np.any(np.diff(found) < 0):
        raise ValueError(f"joules go back at row {_first(np.diff(found) < 0)}")
    if not counts and np.any(found < 0):
        raise ValueError(f"watts are negative at row {_first(found < 0)}")
    # Power is integrated to joules.
    joules = found if counts else integrated(times, found)
    counter = words.get(
        "counter", "recorded" if counts else "recorded-power-integrated"
    )
    return EnergyRecording(
        times,
        joules,
        frames,
        words.get("device", name),
        words.get("scope", "as recorded"),
        counter,
    )


def _numbers(columns: Mapping[str, Sequence[Any]], name: str) -> Floats:
    if name not in columns:
        there = ", ".join(columns) or "none"
        raise ValueError(f"no column {name}; there are {there}, wanted: {_COLUMNS}")
    found = np.array([float(each) for each in columns[name]])
    if not np.all(np.isfinite(found)):
        raise ValueError(f"{name} is not finite at row {_first(~np.isfinite(found))}")
    return found


def _first(wrong: Any) -> int:
    return int(np.argmax(wrong)) + 1
