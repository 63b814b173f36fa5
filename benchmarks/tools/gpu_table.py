"""The tables of :mod:`benchmarks.measure.gpu`."""

import dataclasses
import math
import statistics
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pynvml

from me2e_compress.base.atomic import write_bytes, write_json
from me2e_compress.manager.report import versions
from me2e_compress.runtime.profile import processor

PLANS = {"vad-tiny": "ego_fut_preds", "highway": "plan"}
"""The output that is the plan, by subject."""


@dataclasses.dataclass(frozen=True)
class Found:
    """What was measured of a row, or why it was not."""

    subject: str
    provider: str
    name: str
    reason: str = ""
    megabytes: float | None = None
    measured: dict[str, Any] = dataclasses.field(default_factory=dict)


def write(out: Path, rows: list[Found]) -> None:
    """Write the results so far, and their tables."""
    where = f"{processor()}; {', '.join(gpus()) or 'no NVIDIA GPU'}"
    packages = ", ".join(f"{name} {each}" for name, each in versions().items())
    parts = [f"{where}; {packages}"]
    for name in dict.fromkeys(row.subject for row in rows):
        ours = [row for row in rows if row.subject == name]
        parts.append(f"## {name}\n\n{table(ours)}")
    write_bytes(out / "table.md", ("\n\n".join(parts) + "\n").encode())
    found = [dataclasses.asdict(row) for row in rows]
    about = {"machine": where, "versions": dict(versions())}
    write_json(out / "results.json", {**about, "rows": found})


def gpus() -> list[str]:
    """Return the names of NVIDIA's GPUs here."""
    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError:
        return []
    try:
        handles = map(
            pynvml.nvmlDeviceGetHandleByIndex, range(pynvml.nvmlDeviceGetCount())
        )
        return [str(pynvml.nvmlDeviceGetName(each)) for each in handles]
    finally:
        pynvml.nvmlShutdown()


HEAD = (
    *("provider", "file", "MB", "median ms", "p99 ms", "runs", "GPU MB", "host MB"),
    *("worst SQNR, dB", "plan, dB", "J/frame"),
)


def table(rows: list[Found]) -> str:
    """Write the rows of one subject."""
    lines = [f"| {' | '.join(HEAD)} |", "|---|---|" + "---:|" * (len(HEAD) - 2)]
    for row in rows:
        cells = [row.provider, row.name, *_cells(row)]
        lines.append(f"| {' | '.join(cells)} |")
    return "\n".join([*lines, "", *dict.fromkeys(_notes(rows))])


def _notes(rows: list[Found]) -> Iterator[str]:
    """Say why what is "-" was not measured."""
    for row in rows:
        if not row.reason and row.measured["gpu_reason"]:
            yield f"GPU MB, {row.provider}: {row.measured['gpu_reason']}."
    for row in rows:
        if not row.reason and row.measured["energy"]["reason"]:
            yield f"J/frame, {row.provider}: {row.measured['energy']['reason']}."


def _cells(row: Found) -> list[str]:
    if row.reason:
        return [f"not measured: {row.reason}", *[""] * (len(HEAD) - 3)]
    found = row.measured
    noise = found["sqnr_db"]
    wall = found["wall_s"]
    joules = found["energy"]["j_per_frame"]
    return [
        f"{row.megabytes:.1f}",
        f"{1e3 * statistics.median(wall):.2f}",
        f"{1e3 * float(np.percentile(wall, 99)):.2f}",
        str(len(wall)),
        "-" if found["gpu_mb"] is None else f"{found['gpu_mb']:.0f}",
        f"{found['host_mb']:.0f}",
        _db(min(noise.values(), key=lambda each: math.inf if each is None else each)),
        _db(noise.get(PLANS[row.subject])),
        "-" if joules is None else f"{joules:.3g}",
    ]


def _db(value: float | None) -> str:
    """Write decibels; what is equal to the bit has no noise."""
    return "∞" if value is None else f"{value:.1f}"
