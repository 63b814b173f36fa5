"""The result of a compression: the graph, the report and their tables."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.manager import Report
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.quantization.plan import plan_of, save_plan
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_document
from me2e_compress.workflows.int8_outcome import Int8Outcome
from me2e_compress.workflows.lint import LintResult
from me2e_compress.workflows.measured_loss import MeasuredLoss
from me2e_compress.workflows.result import Result, Status, Table, megabytes, plain
from me2e_compress.workflows.weights_record import named_weights


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
        lint: what the target's rules say of the graph; None where nothing is int8.
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
    lint: LintResult | None = None

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
        measured = None if self.loss is None else self.loss.table()
        return (*self.report.tables(), *filter(None, [measured]))

    def lines(self) -> tuple[str, ...]:
        """Return the verdict: int8, how far outputs and plan moved, time and size."""
        said = (*self.verdict(), self._time, self.headline, self.weights)
        return tuple(filter(None, said))

    def alerts(self) -> tuple[str, ...]:
        """Return warnings: nothing became int8, or quality is below the floor."""
        empty = "" if self.int8 is None else self.int8.empty
        lost = () if self.loss is None else self.loss.alerts()
        return (*lost, *filter(None, [empty]), *self._linted())

    def _linted(self) -> Iterator[str]:
        """Yield what the target refuses, or computes otherwise."""
        if self.lint is not None:
            lines = filter(None, (self.lint.refusal, self.lint.miscomputed))
            yield from (f"lint: {line}" for line in lines)

    def verdict(self) -> Iterator[str]:
        """Yield what became int8, what is proven, and how far the outputs moved."""
        if self.int8 is not None:
            yield self.int8.line
            yield from filter(None, [self.int8.slow_here])
        yield from _proof(self.report)
        if self.loss is not None:
            yield from self.loss.lines()
        if self.lint is not None:
            yield f"lint: {self.lint.headline}"

    @property
    def status(self) -> Status:
        """``refused`` if the target that was asked for refuses what was written."""
        return super().status if self.refusal is None else "refused"

    @property
    def refusal(self) -> str | None:
        """Why the target that the user named refuses the file; None if it does not."""
        if self.lint is None or not self.lint.asked:
            return None
        return self.lint.refusal

    def check(self) -> None:
        """Raise PreconditionError if the target that was asked for refuses the file."""
        if self.refusal is not None:
            raise PreconditionError(f"written, but {self.refusal}")

    @property
    def _time(self) -> str:
        said = f"took {self.seconds:.0f} CPU s"
        if self.loss is not None and self.loss.fidelity is not None:
            said += f", {self.loss.seconds:.0f} of them to measure"
        return said

    def findings(self) -> dict[str, Any]:
        """Return weights, int8, fidelity and verdict for the report, without times.

        The same run thus writes the same file; numbers that are not finite become null.
        """
        found = {
            "weights": self.weights,
            "int8": self.int8,
            "fidelity": None if self.loss is None else self.loss.record(),
            "lint": None if self.lint is None else self.lint.summary(),
            "verdict": [*self.verdict(), *self.alerts()],
        }
        return {name: plain(each) for name, each in found.items()}

    def to_json(self) -> object:
        """Return the report file's content except the verdict, which `lines` has."""
        return {key: each for key, each in self.record.items() if key != "verdict"}


def beside(output: Path, what: str) -> Path:
    """Return the path of the ``plan`` or ``report`` beside a compressed graph."""
    return output.with_name(f"{output.stem}.{what}.json")


def _proof(report: Report) -> Iterator[str]:
    """Say how far exact passes moved the outputs, and what is not proven."""
    judged = [
        (check.errors[name], check.fed)
        for check in report.verifications
        for name in check.judged
    ]
    # with lossy passes in the pipeline, sameness is not the claim
    if judged and not report.lossy:
        worst, inputs = max(judged)
        near = f" to within {worst:.1e} of its largest value" if worst else ""
        yield f"every output is the same{near} ({inputs})"
    if not any(step.changes for step in report.steps):
        yield "every output is the same: no pass changed anything"
    # what could not be proven is said too
    for check in report.verifications:
        if check.unproven is not None:
            yield f"not proven: {', '.join(check.passes)}: {check.unproven}"
        elif check.left_out:
            yield f"not proven of every output: {check.left_out}"
        yield from check.remarks


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
    source: Path,
    output: Path,
    int8: Int8Outcome | None,
    loss: MeasuredLoss | None,
    seconds: float,
    linted: LintResult | None,
) -> CompressResult:
    """Write the graph and its plan, then the report, which vouches for both."""
    plan = plan_of(report.model)  # before writing: metadata may be malformed
    with drafts.all_or_none():
        graph.save(with_own_domains(report.model), output)
        if plan is not None:
            save_plan(plan, beside(output, "plan"))
        sizes = graph.file_bytes(source), graph.file_bytes(output)
        made = CompressResult(
            source, output, report, {}, *sizes, int8, loss, seconds, linted
        )
        record = report.record(source, output) | made.findings()
        write_document(beside(output, "report"), record, indent=2)
    return dataclasses.replace(made, record=record)
