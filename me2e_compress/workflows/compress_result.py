"""The result of a compression: the graph, the report and their tables."""

import dataclasses
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

from me2e_compress import graph
from me2e_compress.errors import GraphError, PreconditionError
from me2e_compress.manager import Report
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.quantization.plan import plan_of, save_plan
from me2e_compress.registry import drafts
from me2e_compress.runtime.atomic import write_document
from me2e_compress.workflows.checks import Given, check_folder
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.int8_outcome import Int8Outcome
from me2e_compress.workflows.lint import LintResult
from me2e_compress.workflows.measured_loss import MeasuredLoss
from me2e_compress.workflows.result import Result, Status, Table, megabytes, plain
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
    first_frames: Mapping[str, "CompressResult"] = dataclasses.field(
        default_factory=dict
    )
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

    def details(self) -> tuple[Table, ...]:
        """Return the largest weights that stay float."""
        weights = None if self.int8 is None else self.int8.table()
        return tuple(filter(None, [weights]))

    def lines(self) -> tuple[str, ...]:
        """Return the verdict: int8, how far outputs and plan moved, time and size."""
        first = (
            f"{name}: {line}"
            for name, each in self.first_frames.items()
            for line in each.verdict()
        )
        said = (*first, *self.verdict(), self._time, self.headline, self.weights)
        return tuple(filter(None, said))

    def alerts(self) -> tuple[str, ...]:
        """Return warnings: nothing became int8, or quality is below the floor."""
        first = (
            f"{name}: {said}"
            for name, each in self.first_frames.items()
            for said in each.alerts()
        )
        empty = "" if self.int8 is None else self.int8.empty
        lost = () if self.loss is None else self.loss.alerts()
        return (*lost, *filter(None, [empty]), *self._linted(), *first)

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
        """Why the target that the user named refuses a file; None if it takes all."""
        linted = (each.lint for each in (self, *self.first_frames.values()))
        asked = (each for each in linted if each is not None and each.asked)
        return next(filter(None, (each.refusal for each in asked)), None)

    def check(self) -> None:
        """Raise PreconditionError if the target that was asked for refuses a file."""
        if self.refusal is not None:
            raise PreconditionError(f"written, but {self.refusal}")

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
        held = {key: each for key, each in self.record.items() if key != "verdict"}
        first = {name: each.to_json() for name, each in self.first_frames.items()}
        return {**held, "first_frames": first}


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


def _written_files(output: Path) -> tuple[Path, ...]:
    """Return every file that may be written for a compressed graph."""
    return (
        output,
        *graph.data_names(output),
        beside(output, "plan"),
        beside(output, "report"),
    )


@contextmanager
def writing_model(
    source: Path, output: Path, inputs: Iterable[Given], *, force: bool
) -> Iterator[Path]:
    """Claim what is written of a model; yield where its graph goes.

    Of a stack that is the TOML of a draft, which takes the place of a folder at the
    end.

    Raises:
        GraphError: The output would harm an input, or is no folder for a stack.
    """
    if not graph.is_stack(source):
        with writing(_written_files(output), inputs, force=force):
            yield output
        return
    if output.suffix in (".onnx", ".toml"):
        raise GraphError(f"{output}: a stack is written as a folder: name one")
    check_folder(output, (*graph.paths_of(source), *inputs))
    with writing(trees=[output], force=force):
        output.parent.mkdir(parents=True, exist_ok=True)
        with TemporaryDirectory(dir=output.parent, prefix=f".{output.name}.") as folder:
            draft = Path(folder) / output.name
            draft.mkdir()
            try:
                yield draft / source.name
            except GraphError as error:
                raise GraphError(str(error).replace(str(draft), str(output))) from error
            drafts.put(draft, output)


def written_model(source: Path, output: Path) -> Path:
    """Return the file that opens what was written: of a stack, the TOML."""
    return output / source.name if graph.is_stack(source) else output


def in_place(found: CompressResult, output: Path) -> CompressResult:
    """Return a result whose files are named where they are once the draft is put."""
    if not graph.is_stack(found.source):
        return found
    first = {
        label: dataclasses.replace(each, output=output / each.output.name)
        for label, each in found.first_frames.items()
    }
    written = written_model(found.source, output)
    return dataclasses.replace(found, output=written, first_frames=first)


def write_result(
    report: Report,
    loaded: graph.LoadedModel,
    output: Path,
    int8: Int8Outcome | None,
    loss: MeasuredLoss | None,
    seconds: float,
    linted: LintResult | None,
) -> CompressResult:
    """Write the graph and its plan, then the report, which vouches for both."""
    plan = plan_of(report.model)  # before writing: metadata may be malformed
    source = loaded.path
    with drafts.all_or_none():
        loaded.save(with_own_domains(report.model), output)
        if plan is not None:
            save_plan(plan, beside(output, "plan"))
        sizes = graph.file_bytes(source), graph.file_bytes(output)
        made = CompressResult(
            source, output, report, {}, *sizes, int8, loss, seconds, {}, linted
        )
        record = report.record(source, output) | made.findings()
        write_document(beside(output, "report"), record, indent=2)
    return dataclasses.replace(made, record=record)
