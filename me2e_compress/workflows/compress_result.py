"""What a compression made: the graph, the report and their tables."""

import dataclasses
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path

from me2e_compress.manager import Report, Step, Verification
from me2e_compress.workflows.result import (
    AT_LEAST,
    Result,
    Table,
    giga,
    megabytes,
    table,
)


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
        report = self.report
        return steps_table(report.steps), verification_table(report.verifications)

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


def steps_table(steps: Sequence[Step]) -> Table:
    """Show pass by pass what changed and what it cost, and what the passes say."""
    notes = [f"{step.name}: {note}" for step in steps for note in step.notes]
    if any(step.after.unknown_macs_nodes for step in steps):
        notes.append(AT_LEAST)
    return table(
        "Pass by pass",
        ("pass", "changes", "nodes", "weights MB", "GMACs", "CPU s"),
        [
            (
                step.name,
                str(step.changes),
                f"{step.before.nodes} → {step.after.nodes}",
                f"{megabytes(step.before.weight_bytes)} →"
                f" {megabytes(step.after.weight_bytes)}",
                giga(step.after.macs, step.after.unknown_macs_nodes),
                f"{step.seconds:.2f}",
            )
            for step in steps
        ],
        "\n".join(notes),
    )


def verification_table(verifications: Iterable[Verification]) -> Table:
    """Show how far exact passes moved the outputs."""
    rows, unsteady = list[tuple[str, ...]](), False
    for check in verifications:
        names = ", ".join(check.passes)
        if check.skipped is not None:
            rows.append((names, f"not measured: {check.skipped}", "", "", ""))
            continue
        judged = [name for name in check.errors if name not in check.unsteady]
        for worst in sorted(judged, key=lambda name: -check.errors[name])[:1]:
            error, allowed = check.errors[worst], check.tolerances[worst]
            rows.append((names, check.inputs, worst, f"{error:.1e}", f"{allowed:.0e}"))
        if check.unsteady:
            listed, unsteady = ", ".join(check.unsteady), True
            rows.append((names, check.inputs, listed, "not judged", ""))
    return table(
        "Exact passes, checked by running both graphs",
        ("passes", "inputs", "worst output", "max|a-b|/max|a|", "allowed"),
        rows,
        "not judged: on these inputs rounding alone moves the output as far; "
        "recorded frames (--frames) tell more"
        if unsteady
        else "",
        words=3,
    )
