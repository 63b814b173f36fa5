"""Look at saved ranges, alone or beside those of another recording or a cache."""

import dataclasses
from pathlib import Path

from me2e_compress.calibration.exchange import read_cache
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.review import (
    RangeFinding,
    factor,
    ratios_of,
    reach_of,
    review,
    review_beside,
)
from me2e_compress.errors import FramesError
from me2e_compress.registry import documents
from me2e_compress.workflows.result import Result, Table, number, table

_SHOWN = 10
"""Rows of the table; ``--json`` has all tensors."""


@dataclasses.dataclass(frozen=True, repr=False)
class RangesResult(Result):
    """Saved ranges, those that they were compared with, and what deserves a look."""

    path: Path
    ranges: Ranges
    other_path: Path | None
    other: Ranges | None
    findings: tuple[RangeFinding, ...]

    @property
    def headline(self) -> str:
        """The number of tensors, the method and the number of frames."""
        return f"{self.path}: {self.ranges.headline}"

    def tables(self) -> tuple[Table, ...]:
        """Return a table of the tensors that are furthest off."""
        columns = ["low", "high", "rms", "crest"]
        if self.other is not None:
            columns += ["other", "ratio"]
        cells = [
            [str(row["tensor"]), *(_written(row[each]) for each in columns)]
            for row in self._rows()[:_SHOWN]
        ]
        heads = {"crest": "range / rms", "other": f"range in {self.other_path}"}
        named = ["tensor", *(heads.get(each, each) for each in columns)]
        return (table("Ranges, the furthest off first", named, cells),)

    def lines(self) -> tuple[str, ...]:
        """Return the headlines, and what may be meant."""
        other = (
            () if self.other is None else (f"{self.other_path}: {self.other.headline}",)
        )
        return (self.headline, *other, *self._said("note"))

    def alerts(self) -> tuple[str, ...]:
        """Return what is wrong for all that is known."""
        return self._said("warning")

    def _rows(self) -> list[dict[str, object]]:
        """Return one row per tensor; what is not known is None."""
        crests = self.ranges.crests
        others = {} if self.other is None else self.other.tensors
        ratios = {} if self.other is None else ratios_of(self.ranges, self.other)
        rows: dict[str, dict[str, object]] = {
            name: {
                "tensor": name,
                "low": low,
                "high": high,
                "rms": self.ranges.rms.get(name),
                "crest": crests.get(name),
                "other": reach_of(others[name]) if name in others else None,
                "ratio": ratios.get(name),
            }
            for name, (low, high) in self.ranges.tensors.items()
        }
        off = {name: factor(ratio) for name, ratio in ratios.items()} or crests
        order = sorted(rows, key=lambda name: -off.get(name, 0.0))
        return [rows[name] for name in order]

    def to_json(self) -> object:
        """Return what was found, and every tensor."""
        return {"findings": self.findings, "tensors": self._rows()}

    def _said(self, severity: str) -> tuple[str, ...]:
        return tuple(str(each) for each in self.findings if each.severity == severity)


def _written(value: object) -> str:
    return number(value if isinstance(value, float) else None, ".4g")


def ranges(path: str | Path, other: str | Path | None = None) -> RangesResult:
    """Say which saved ranges deserve a look, and what to record instead.

    Either file is ranges that ``calibrate`` saved, a TensorRT calibration cache, or an
    onnxruntime ``calibration.cache``. With ``other``, ranges are also held against its
    own: another recording's of the same graph, or another tool's.

    Raises:
        FramesError: A file does not exist, contradicts itself, or is of another graph.
    """
    mine = _read(Path(path))
    if other is None:
        return RangesResult(Path(path), mine, None, None, review(mine))
    theirs = _read(Path(other))
    found = (*review(mine), *review_beside(mine, theirs, str(other)))
    return RangesResult(Path(path), mine, Path(other), theirs, found)


def _read(path: Path) -> Ranges:
    """Read ranges of ours, or another tool's cache."""
    if not path.is_file():
        raise FramesError(f"{path}: no such ranges file or calibration cache")
    with documents.reading(path, FramesError, "not ranges"):
        is_json = documents.content(path)[:64].lstrip().startswith(b"{")
    return Ranges.load(path) if is_json else read_cache(path)
