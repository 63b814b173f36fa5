"""Write a model that ships as a file of the user."""

import dataclasses
from pathlib import Path

from me2e_compress.graph import file_bytes
from me2e_compress.shipped import drivers as shipped
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.result import Result, megabytes


@dataclasses.dataclass(frozen=True, repr=False)
class ExportResult(Result):
    """A model that was written."""

    stack: str
    output: Path

    @property
    def headline(self) -> str:
        """The file, its model and size."""
        return f"{self.output}: {self.stack}, {megabytes(file_bytes(self.output))} MB"


def export_stack(
    stack: str, output: str | Path, *, force: bool = False
) -> ExportResult:
    """Write a copy of a trained model that ships: ``highway``.

    The folder of the output is made if needed. ``force`` replaces a file that we did
    not write, too.

    Raises:
        GraphError: No such model ships, or the output is not usable.
    """
    output = Path(output)
    files = [output] if output.parent.is_dir() else []  # else it is made
    with writing(files, force=force):
        shipped.copy(stack, output)
    return ExportResult(stack, output)
