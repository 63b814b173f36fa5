"""The result of a calibration: ranges, or the statistics of one shard."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.workflows.result import Result, counted

_SHOWN = 5
"""Number of tensors of a kind that are listed."""


@dataclasses.dataclass(frozen=True, repr=False)
class CalibrateResult(Result):
    """The range of every tensor; or a shard's statistics, with `ranges` of None.

    Of a stack, `first_frames` has those of each file for first frames, by label.
    """

    output: Path
    frames: int
    ranges: Ranges | None
    shard: str | None = None
    first_frames: Mapping[str, "CalibrateResult"] = dataclasses.field(
        default_factory=dict
    )

    @property
    def headline(self) -> str:
        """The file, and the number of tensors, the method and the number of frames."""
        if self.ranges is None:
            return f"{self.output}: shard {self.shard}, {counted(self.frames, 'frame')}"
        found = self.ranges
        return (
            f"{self.output}: {counted(len(found.tensors), 'tensor')}, {found.method},"
            f" {counted(found.frames, 'frame')}"
        )

    def lines(self) -> tuple[str, ...]:
        """Return the headline, and the ranges that deserve a look."""
        if self.ranges is None:
            return (self.headline,)
        worst = sorted(self.ranges.outliers.items(), key=lambda item: -item[1])
        outliers = [f"{name} (largest / rms {crest:.0f})" for name, crest in worst]
        return (
            *(line for each in self.first_frames.values() for line in each.lines()),
            self.headline,
            *_first(list(self.ranges.dead), "always zero"),
            *_first(outliers, "a few elements make the range"),
        )

    def records(self) -> list[dict[str, object]]:
        """Return one row per tensor."""
        tensors = {} if self.ranges is None else self.ranges.tensors
        return [
            {"tensor": name, "low": low, "high": high}
            for name, (low, high) in tensors.items()
        ]

    def to_json(self) -> object:
        """Return the ranges and the tensors that are always zero, or the shard."""
        if self.ranges is None:
            return {"shard": self.shard, "frames": self.frames}
        first = {name: each.to_json() for name, each in self.first_frames.items()}
        own = {**dataclasses.asdict(self.ranges), "dead": self.ranges.dead}
        return {**own, "first_frames": first}


def beside_ranges(ranges: Path, label: str) -> Path:
    """Return where the ranges of a file for first frames stand."""
    return ranges.with_name(f"{ranges.stem}.{label}.json")


def _first(names: list[str], what: str) -> tuple[str, ...]:
    if not names:
        return ()
    more = f"; and {len(names) - _SHOWN} more" if len(names) > _SHOWN else ""
    return (f"{len(names)} {what}: {'; '.join(names[:_SHOWN])}{more}",)
