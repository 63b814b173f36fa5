"""The result of a calibration."""

import dataclasses
from pathlib import Path

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.calibration.review import RangeFinding
from me2e_compress.workflows.result import Result, counted


@dataclasses.dataclass(frozen=True, repr=False)
class CalibrateResult(Result):
    """The range of every tensor.

    `findings` say what of the ranges deserves a look. `overrides` is the file that
    keeps in float what an imported cache has no range for; None where it has all.
    """

    output: Path
    frames: int
    ranges: Ranges
    findings: tuple[RangeFinding, ...] = ()
    overrides: Path | None = None

    @property
    def headline(self) -> str:
        """The file, and the number of tensors, the method and the number of frames."""
        found = self.ranges
        return (
            f"{self.output}: {counted(len(found.tensors), 'tensor')}, {found.method},"
            f" {counted(found.frames, 'frame')}"
        )

    def lines(self) -> tuple[str, ...]:
        """Return the headline, and the ranges that deserve a look."""
        return (self.headline, *self._said("note"))

    def alerts(self) -> tuple[str, ...]:
        """Return what is wrong with the ranges for all that is known."""
        how = f"compress --ranges {self.output} --overrides {self.overrides}"
        also = () if self.overrides is None else (f"These floats: {how}",)
        return (*self._said("warning"), *also)

    def _said(self, severity: str) -> tuple[str, ...]:
        return tuple(str(each) for each in self.findings if each.severity == severity)

    def to_json(self) -> object:
        """Return the ranges and the tensors that are always zero."""
        found = self.ranges
        own = {**dataclasses.asdict(found), "dead": found.dead}
        own |= {"outliers": found.outliers, "findings": self.findings}
        return {**own, "overrides": self.overrides}
