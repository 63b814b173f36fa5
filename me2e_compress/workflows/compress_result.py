"""The result of a compression: the graph, the report and their tables."""

import dataclasses
import math
from collections.abc import Mapping
from pathlib import Path

from me2e_compress import drafts, graph
from me2e_compress.manager import Report
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.quantization.plan import plan_of, save_plan
from me2e_compress.runtime.atomic import write_document
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
        output: the file that was written, with ``STEM.report.json`` beside it and,
            where the graph was quantized, ``STEM.plan.json``.
        record: what ``STEM.report.json`` holds.
        source_bytes: size with external weights, as `output_bytes` is.
        int8: what became int8 and what did not; None where no pass quantizes.
        loss: how true the graph stayed; None where every pass is exact.
        seconds: CPU time of everything but the writing.
        first_frames: of a stack, how each file for first frames came to be, by label.
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
    first_frames: Mapping[str, "CompressResult"] = dataclasses.field(
        default_factory=dict
    )

    @property
    def report_path(self) -> Path:
        """The file of the report."""
        return beside(self.output, "report")

    @property
    def weights(self) -> str:
        """The checkpoint that the graph was made from; empty if not known."""
        return named_weights(self.report.model.metadata_props)

    @property
    def size(self) -> str:
        """The size in MB, and its share of the source's."""
        share = self.output_bytes / self.source_bytes
        return f"{megabytes(self.output_bytes)} MB, {share:.1%} of {self.source.name}"

    @property
    def headline(self) -> str:
        """The file, its size and the report."""
        return f"{self.output}: {self.size}; report: {self.report_path}"

    def tables(self) -> tuple[Table, ...]:
        """Return each pass with its changes and its check, then the fidelity."""
        measured = None if self.loss is None else fidelity_table(self.loss)
        return (*self.report.tables(), *filter(None, [measured]))

    def details(self) -> tuple[Table, ...]:
        """Return the largest weights that stay float."""
        weights = None if self.int8 is None else weights_table(self.int8)
        return tuple(filter(None, [weights]))

    def lines(self) -> tuple[str, ...]:
        """Return the verdict: int8, how far outputs and plan moved, time and size."""
        said = (*verdict(self.report, self.int8, self.loss), self._time, self.headline)
        first = (
            f"{name}: {line}"
            for name, each in self.first_frames.items()
            for line in verdict(each.report, each.int8, each.loss)
        )
        return (*first, *said, *filter(None, [self.weights]))

    def alerts(self) -> tuple[str, ...]:
        """Return warnings: nothing became int8, or quality is below the floor."""
        first = (
            f"{name}: {said}"
            for name, each in self.first_frames.items()
            for said in each.alerts()
        )
        return (*alerts(self.int8, self.loss), *first)

    @property
    def _time(self) -> str:
        said = f"took {self.seconds:.0f} CPU s"
        if self.loss is not None and self.loss.fidelity is not None:
            said += f", {self.loss.seconds:.0f} of them to measure"
        return said

    def records(self) -> list[dict[str, object]]:
        """Return one row per pass."""
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
        """Return the report file's content except the verdict, which `lines` has."""
        held = {key: each for key, each in self.record.items() if key != "verdict"}
        first = {name: each.to_json() for name, each in self.first_frames.items()}
        return {**held, "first_frames": first}


def beside(output: Path, what: str) -> Path:
    """Return the path of the ``plan`` or ``report`` beside a compressed graph."""
    return output.with_name(f"{output.stem}.{what}.json")


def loss_record(
    report: Report, int8: Int8Outcome | None, loss: MeasuredLoss | None
) -> dict[str, object]:
    """Return the report's int8, fidelity and verdict, without times.

    The same run thus writes the same file; numbers that are not finite become null.
    """
    return {
        "int8": None if int8 is None else dataclasses.asdict(int8),
        "fidelity": None if loss is None else fidelity_record(loss),
        "verdict": [*verdict(report, int8, loss), *alerts(int8, loss)],
    }


def fidelity_record(loss: MeasuredLoss) -> dict[str, object]:
    """Return the report's fidelity; numbers that are not finite become null."""
    remedy = loss.remedy
    found = dataclasses.asdict(dataclasses.replace(loss, remedy=None))
    del found["seconds"]
    if remedy is not None:
        found["remedy"] = dataclasses.asdict(remedy) | {"overrides": remedy.overrides()}
    return {name: _finite(value) for name, value in found.items()}


def _finite(value: object) -> object:
    """Replace numbers that are not finite, at any depth, by None."""
    if isinstance(value, Mapping):
        return {key: _finite(each) for key, each in value.items()}
    if isinstance(value, (list, tuple)):
        return [_finite(each) for each in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


def written_files(output: Path) -> tuple[Path, ...]:
    """Return every file that may be written for a compressed graph."""
    return (
        output,
        *graph.data_names(output),
        beside(output, "plan"),
        beside(output, "report"),
    )


def write_result(
    report: Report,
    loaded: graph.LoadedModel,
    output: Path,
    int8: Int8Outcome | None,
    loss: MeasuredLoss | None,
    seconds: float,
) -> CompressResult:
    """Write the graph and its plan, then the report, which vouches for both."""
    plan = plan_of(report.model)  # before writing: metadata may be malformed
    source, weights = (
        loaded.path,
        {"weights": named_weights(report.model.metadata_props)},
    )
    with drafts.all_or_none():
        loaded.save(with_own_domains(report.model), output)
        if plan is not None:
            save_plan(plan, beside(output, "plan"))
        about = weights | loss_record(report, int8, loss)
        record = report.record(source, output) | about
        write_document(beside(output, "report"), record, indent=2)
    sizes = graph.file_bytes(source), graph.file_bytes(output)
    return CompressResult(source, output, report, record, *sizes, int8, loss, seconds)
