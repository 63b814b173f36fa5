"""What a compression made: the graph, the report and their tables."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path

from me2e_compress.manager import Report
from me2e_compress.workflows.result import Result, Table, megabytes


@dataclasses.dataclass(frozen=True, repr=False)
class CompressResult(Result):
    """A compressed graph, and how it came to be.

    Attributes:
        source: the file that was compressed.
        output: the file that was written; beside it ``STEM.report.json`` and, where
            the graph was quantized, ``STEM.plan.json``.
        report: pass by pass, with the graph.
        record: what ``STEM.report.json`` holds.
        source_bytes: with the weights beside it.
        output_bytes: with the weights beside it.
    """

    source: Path
    output: Path
    report: Report
    record: Mapping[str, object]
    source_bytes: int
    output_bytes: int

    @property
    def report_path(self) -> Path:
        """Where the report lies."""
        return beside(self.output, "report")

    @property
    def headline(self) -> str:
        """File, size, report."""
        share = self.output_bytes / self.source_bytes
        return (
            f"{self.output}: {megabytes(self.output_bytes)} MB, {share:.1%} of"
            f" {self.source.name}; report: {self.report_path}"
        )

    def tables(self) -> tuple[Table, ...]:
        """Return pass by pass what changed, and how exact passes were checked."""
        return self.report.tables()

    def records(self) -> list[dict[str, object]]:
        """Return a row a pass."""
        return [
            {
                "pass": step.name,
                "changes": step.changes,
                "nodes": step.after.nodes,
                "weight_bytes": step.after.weight_bytes,
                "macs": step.after.macs,
                "unknown_macs_nodes": step.after.unknown_macs_nodes,
                "seconds": step.seconds,
            }
            for step in self.report.steps
        ]

    def to_json(self) -> object:
        """Return what the report file holds."""
        return self.record


def beside(output: Path, what: str) -> Path:
    """Name the file that lies beside a compressed graph: ``plan`` or ``report``."""
    return output.with_name(f"{output.stem}.{what}.json")
