"""A reference stack as ONNX."""

import dataclasses
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

from me2e_compress.errors import GraphError
from me2e_compress.graph import file_bytes
from me2e_compress.workflows.checks import check_count
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.result import Result, Table, megabytes
from me2e_compress.zoo import export as exporter
from me2e_compress.zoo import shipped

OPSET = 17
"""Of the shipped models, and of the others unless asked otherwise."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """How a stack is written; a trained model leaves nothing to choose.

    Attributes:
        opset: ONNX opset of the file.
        heads: classes and ego modes of vad-tiny; None is nuScenes'.
        seed: of the initial weights; None is 0.
        force: replace outputs that are not as we left them, too.

    Raises:
        RecipeError: a seed below 0.
    """

    opset: int = OPSET
    heads: Literal["nuscenes", "bench2drive"] | None = None
    seed: int | None = None
    force: bool = False

    def __post_init__(self) -> None:
        """Check the seed."""
        check_count("--seed", self.seed or 0)


@dataclasses.dataclass(frozen=True, repr=False)
class ExportResult(Result):
    """A stack that was written.

    Attributes:
        stack: its name.
        output: the file.
        opset: of the file.
    """

    stack: str
    output: Path
    opset: int

    @property
    def headline(self) -> str:
        """File, stack, opset, size."""
        size = megabytes(file_bytes(self.output))
        return f"{self.output}: {self.stack}, opset {self.opset}, {size} MB"

    def tables(self) -> tuple[Table, ...]:
        """Return none: the line says it."""
        return ()

    def records(self) -> list[dict[str, object]]:
        """Return one row: the file."""
        return [
            {
                "stack": self.stack,
                "output": self.output,
                "opset": self.opset,
                "bytes": file_bytes(self.output),
            }
        ]

    def to_json(self) -> object:
        """Return the file: stack, path, opset, bytes."""
        return self.records()[0]


def export_stack(
    stack: str, output: str | Path, options: ExportOptions | None = None
) -> Path:
    """Write a reference stack as ONNX: VAD-tiny drawn from a seed, or our driver.

    Args:
        stack: ``vad-tiny`` or ``highway``.
        output: the file; its folder is made.
        options: None takes the defaults.

    Returns:
        The file.

    Raises:
        GraphError: no such stack or opset, options for a trained model, or an output
            that cannot be written.
        MissingExtraError: exporting needs the extra ``zoo``.
    """
    options, output = options or ExportOptions(), Path(output)
    files = [output] if output.parent.is_dir() else []  # else it is made
    with writing(files, force=options.force):
        return _exported(stack, output, options)


def _exported(stack: str, output: Path, options: ExportOptions) -> Path:
    if stack not in shipped.SHIPPED:
        return exporter.export(
            stack,
            output,
            opset=options.opset,
            seed=options.seed or 0,
            heads=options.heads or "nuscenes",
        )
    _refuse(stack, {"--seed": options.seed, "--heads": options.heads}, options.opset)
    return shipped.copy(stack, output)


def _refuse(stack: str, options: Mapping[str, object], opset: int) -> None:
    """Refuse options: a trained model is one file."""
    given = [option for option, value in options.items() if value is not None]
    if opset != OPSET:
        given.append(f"--opset {opset}")
    if given:
        raise GraphError(
            f"{stack} is a trained model of opset {OPSET}: {given[0]} cannot be chosen"
        )
