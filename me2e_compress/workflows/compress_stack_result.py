"""The result of a stack's compression: files, report, tables."""

import dataclasses
from collections.abc import Iterator, Mapping
from pathlib import Path

from me2e_compress.runtime.stack.split_stack import SplitStack
from me2e_compress.workflows.compress_fidelity import MeasuredLoss
from me2e_compress.workflows.compress_result import CompressResult, fidelity_record
from me2e_compress.workflows.compress_verdict import fidelity_line, fidelity_table
from me2e_compress.workflows.result import Result, Table, megabytes, table

REPORT = "report.json"
"""The report of a stack, beside its TOML."""


@dataclasses.dataclass(frozen=True, repr=False)
class StackCompressResult(Result):
    """A compressed stack, and how each of its files came to be.

    Attributes:
        source: the TOML of the stack that was compressed.
        output: the TOML that was written.
        record: what ``report.json`` holds.
        loss: how true the whole stayed; None where every pass of every file is exact.
        seconds: CPU time of everything but the writing.
    """

    source: Path
    output: Path
    files: Mapping[str, CompressResult]
    record: Mapping[str, object]
    loss: MeasuredLoss | None = None
    seconds: float = 0.0

    @property
    def headline(self) -> str:
        """The TOML, its size and the report."""
        before = sum(each.source_bytes for each in self.files.values())
        after = sum(each.output_bytes for each in self.files.values())
        return (
            f"{self.output}: {megabytes(after)} MB, {after / before:.1%} of"
            f" {self.source.name}; report: {self.output.with_name(REPORT)}"
        )

    def tables(self) -> tuple[Table, ...]:
        """Return what changed in each file, and the fidelity of the whole."""
        rows = [
            (
                name,
                str(len(each.report.steps)),
                _nodes(each),
                "" if each.int8 is None else str(each.int8.nodes),
                f"{megabytes(each.source_bytes)} → {megabytes(each.output_bytes)}",
            )
            for name, each in self.files.items()
        ]
        columns = ("file", "passes", "nodes", "int8", "MB")
        measured = None if self.loss is None else fidelity_table(self.loss)
        files = table("File by file", columns, rows)
        return (files, *filter(None, [measured]))

    def details(self) -> tuple[Table, ...]:
        """Return the tables of every file."""
        return tuple(each for file in self.files.values() for each in file.tables())

    def lines(self) -> tuple[str, ...]:
        """Return the verdict: how far outputs and plan moved, time, size, weights."""
        said = (*self._fidelity(), f"took {self.seconds:.0f} CPU s", self.headline)
        weights = dict.fromkeys(each.weights for each in self.files.values())
        return (*said, *filter(None, weights))

    def alerts(self) -> tuple[str, ...]:
        """Return the warnings of the whole, and of each file."""
        return (*self._below(), *self._of_files())

    def records(self) -> list[dict[str, object]]:
        """Return one row per file and pass."""
        return [
            {"file": name, **record}
            for name, each in self.files.items()
            for record in each.records()
        ]

    def to_json(self) -> object:
        """Return the content of the report file."""
        return self.record

    def _fidelity(self) -> Iterator[str]:
        if self.loss is None:
            return
        if self.loss.fidelity is None:
            yield f"fidelity of the whole: not measured ({self.loss.on})"
        else:
            yield f"the whole: {fidelity_line(self.loss.fidelity, self.loss)}"

    def _below(self) -> Iterator[str]:
        if self.loss is None:
            return
        if self.loss.incomparable:
            yield f"the outputs cannot be compared: {self.loss.on}"
        if self.loss.shortfalls:
            listed = ", ".join(map(str, self.loss.shortfalls))
            yield f"the whole is below the floor ({self.loss.floor}): {listed}"

    def _of_files(self) -> Iterator[str]:
        for name, each in self.files.items():
            empty = None if each.int8 is None else each.int8.empty
            yield from (f"{name}: {said}" for said in each.alerts() if said != empty)


def stack_record(
    whole: SplitStack,
    small: SplitStack,
    files: Mapping[str, CompressResult],
    loss: MeasuredLoss | None,
) -> dict[str, object]:
    """Return the stack's report: digests, every file's report, the whole's fidelity."""
    return {
        "source": {"file": whole.path.name, "sha256": whole.sha256()},
        "output": {"file": small.path.name, "sha256": small.sha256()},
        "files": {name: dict(each.record) for name, each in files.items()},
        "fidelity": None if loss is None else fidelity_record(loss),
    }


def _nodes(found: CompressResult) -> str:
    steps = found.report.steps
    return f"{steps[0].before.nodes} → {steps[-1].after.nodes}" if steps else ""
