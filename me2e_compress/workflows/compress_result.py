"""What a compression made: the graph, the report and their tables."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

from me2e_compress import drafts, graph
from me2e_compress.manager import Report
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.quantization.plan import plan_of, save_plan
from me2e_compress.runtime.atomic import write_json
from me2e_compress.workflows.compress_fidelity import MeasuredLoss
from me2e_compress.workflows.compress_verdict import (
    alerts,
    fidelity_table,
    verdict,
    weights_table,
)
from me2e_compress.workflows.int8_outcome import Int8Outcome
from me2e_compress.workflows.result import Result, Table, megabytes
from me2e_compress.zoo.weights_record import named_weights


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
        int8: what became int8 and what did not; None where no pass quantizes.
        loss: how true the graph stayed; None where every pass is exact.
        seconds: CPU time of everything but the writing.
    """

    source: Path
    output: Path
    report: Report
    record: Mapping[str, object]
    source_bytes: int
    output_bytes: int
    int8: Int8Outcome | None = None
    loss: MeasuredLoss | None = None
    seconds: float = 0.0

    @property
    def report_path(self) -> Path:
        """Where the report lies."""
        return beside(self.output, "report")

    @property
    def weights(self) -> str:
        """The checkpoint that the graph was made of, in a line; empty: not known."""
        return named_weights(self.report.model.metadata_props)

    @property
    def size(self) -> str:
        """MB, and the share of what was compressed."""
        share = self.output_bytes / self.source_bytes
        return f"{megabytes(self.output_bytes)} MB, {share:.1%} of {self.source.name}"

    @property
    def headline(self) -> str:
        """File, size, report."""
        return f"{self.output}: {self.size}; report: {self.report_path}"

    def tables(self) -> tuple[Table, ...]:
        """Return pass by pass what changed, how it was checked, and how true it is."""
        measured = None if self.loss is None else fidelity_table(self.loss)
        return (*self.report.tables(), *filter(None, [measured]))

    def details(self) -> tuple[Table, ...]:
        """Return the largest weights that stay float."""
        weights = None if self.int8 is None else weights_table(self.int8)
        return tuple(filter(None, [weights]))

    def lines(self) -> tuple[str, ...]:
        """Return the verdict: size, int8, how far outputs and plan moved, time."""
        said = (*verdict(self.report, self.int8, self.loss), self._time, self.headline)
        return (*said, *filter(None, [self.weights]))

    def alerts(self) -> tuple[str, ...]:
        """Return what must not be overlooked: no int8, or quality below the floor."""
        return tuple(alerts(self.int8, self.loss))

    @property
    def _time(self) -> str:
        said = f"took {self.seconds:.0f} CPU s"
        if self.loss is not None and self.loss.fidelity is not None:
            said += f", {self.loss.seconds:.0f} of them to measure"
        return said

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
        """Return what the report file holds; the verdict, with times, is `lines`."""
        return {key: each for key, each in self.record.items() if key != "verdict"}


def beside(output: Path, what: str) -> Path:
    """Name the file that lies beside a compressed graph: ``plan`` or ``report``."""
    return output.with_name(f"{output.stem}.{what}.json")


def loss_record(
    report: Report, int8: Int8Outcome | None, loss: MeasuredLoss | None
) -> dict[str, object]:
    """Return what a report file says of int8 and fidelity; null: not finite, or none.

    Times are left out: the same run writes the same.
    """
    return {
        "int8": None if int8 is None else dataclasses.asdict(int8),
        "fidelity": None if loss is None else fidelity_record(loss),
        "verdict": [*verdict(report, int8, loss), *alerts(int8, loss)],
    }


def fidelity_record(loss: MeasuredLoss) -> dict[str, object]:
    """Return what a report file says of fidelity; null where it is not finite."""
    remedy = loss.remedy
    found = dataclasses.asdict(dataclasses.replace(loss, remedy=None))
    del found["seconds"]
    if remedy is not None:
        found["remedy"] = dataclasses.asdict(remedy) | {"overrides": remedy.overrides()}
    return {name: _finite(value) for name, value in found.items()}


def _finite(value: object) -> object:
    """Replace what is not a finite number, at any depth, by None."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def written_files(output: Path) -> tuple[Path, ...]:
    """Name every file that may be written beside a compressed graph, and that."""
    return (
        output,
        *graph.data_names(output),
        beside(output, "plan"),
        beside(output, "report"),
    )


def write_result(
    report: Report,
    source: Path,
    output: Path,
    int8: Int8Outcome | None,
    loss: MeasuredLoss | None,
    seconds: float,
) -> CompressResult:
    """Write the graph and its plan; the report last, it vouches for the others."""
    plan = plan_of(report.model)  # first: what the file brought may be none
    weights = {"weights": named_weights(report.model.metadata_props)}
    with drafts.all_or_none():
        graph.save(with_own_domains(report.model), output)
        if plan is not None:
            save_plan(plan, beside(output, "plan"))
        about = weights | loss_record(report, int8, loss)
        record = report.record(source, output) | about
        write_json(beside(output, "report"), record, indent=2)
    sizes = graph.file_bytes(source), graph.file_bytes(output)
    return CompressResult(source, output, report, record, *sizes, int8, loss, seconds)
