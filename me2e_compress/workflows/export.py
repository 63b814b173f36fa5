"""A reference stack as ONNX."""

import dataclasses
import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.errors import GraphError, RecipeError
from me2e_compress.graph import file_bytes
from me2e_compress.operators import (
    OWN_DOMAIN,
    dialect_of,
    fused_nodes,
    import_domains,
    translate,
)
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.passes.fold_constants.knowledge import Sweep
from me2e_compress.passes.import_normalize import with_own_domains
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
        heads: which last layers: ``nuscenes`` or ``bench2drive`` of vad-tiny,
            ``bench2drive`` or ``beta`` of tcp; None is the first.
        seed: of the initial weights; None is 0.
        force: replace outputs that are not as we left them, too.
        operators: ``plugin`` writes deformable attention as one node.
        dialect: of which library that node is; None is the toolkit's own form.

    Raises:
        RecipeError: a seed below 0, a dialect that has no deformable attention, or one
            where operators are standard.
    """

    opset: int = OPSET
    heads: str | None = None
    seed: int | None = None
    force: bool = False
    operators: Literal["standard", "plugin"] = "standard"
    dialect: str | None = None

    def __post_init__(self) -> None:
        """Check seed and dialect."""
        check_count("--seed", self.seed or 0)
        names = [each.name for each in DeformableAttention().all_dialects()]
        if self.dialect is not None and self.operators != "plugin":
            raise RecipeError(f"--dialect {self.dialect} needs --operators plugin")
        if self.dialect is not None and self.dialect not in names:
            raise RecipeError(
                f"--dialect {self.dialect}: no library of deformable attention; there"
                f" are {', '.join(names)}"
            )


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
    """Write a reference stack as ONNX, drawn from a seed, or our driver.

    Args:
        stack: ``vad-tiny``, ``tcp`` or ``highway``.
        output: the file; its folder is made.
        options: None takes the defaults.

    Returns:
        The file.

    Raises:
        GraphError: no such stack, heads or opset, options for a trained model, or an
            output that cannot be written.
        MissingExtraError: exporting needs the extra ``zoo``.
    """
    options, output = options or ExportOptions(), Path(output)
    files = [output] if output.parent.is_dir() else []  # else it is made
    with writing(files, force=options.force):
        return _exported(stack, output, options)


def _exported(stack: str, output: Path, options: ExportOptions) -> Path:
    fused = options.operators == "plugin"
    if stack in shipped.SHIPPED:
        given = {"--seed": options.seed, "--heads": options.heads}
        _refuse(stack, {**given, "--operators": fused or None}, options.opset)
        return shipped.copy(stack, output)
    if not fused:
        return _drawn(stack, output, options)
    with tempfile.TemporaryDirectory(prefix="me2e-export-") as folder:
        own = _drawn(stack, Path(folder, "own.onnx"), options)
        model = in_dialect(graph.load(own), options.dialect or OWN_DOMAIN)
        output.parent.mkdir(parents=True, exist_ok=True)
        graph.save(model, output)
    return output


def _drawn(stack: str, output: Path, options: ExportOptions) -> Path:
    return exporter.export(
        stack,
        output,
        opset=options.opset,
        seed=options.seed or 0,
        heads=options.heads,
        fused=options.operators == "plugin",
    )


def in_dialect(model: ir.Model, dialect: str) -> ir.Model:
    """Write the fused nodes of a graph in a dialect, with the shapes of what they give.

    Returns:
        The graph, whose plugins stand in the domain that the dialect gives them.

    Raises:
        PreconditionError: the dialect cannot say one of them.
    """
    _record_shapes(model)
    for fused in fused_nodes(model):
        to = dialect_of(fused.operator, dialect)
        if to is not None and to != fused.dialect:
            translate(fused.node, to, opset=fused.opset, by="export", names=fused.names)
    import_domains(model)
    rewrite.sweep(model)
    graph.infer_shapes(model)
    return with_own_domains(model)


def _record_shapes(model: ir.Model) -> None:
    """Record the shapes that shape arithmetic gives; the nodes stay as they are."""
    copy = model.clone()
    rewrite.lift_constants(copy)
    left, before = _unshaped(copy), -1
    while left != before:
        before = left
        graph.infer_shapes(copy)
        sweep = Sweep(
            copy.opset_imports, set(), set(), through_compute=False, trust_shapes=True
        )
        sweep.run(copy.graph)
        left = _unshaped(copy)
    known = {value.name: value for node in copy.graph for value in node.outputs}
    for node in model.graph:
        for value in node.outputs:
            found = known.get(value.name)
            if found is not None and not value.is_graph_output():
                value.shape, value.type = found.shape, found.type


def _unshaped(model: ir.Model) -> int:
    values = (value for node in model.graph for value in node.outputs)
    return sum(graph.static_shape(value) is None for value in values)


def _refuse(stack: str, options: Mapping[str, object], opset: int) -> None:
    """Refuse options: a trained model is one file."""
    given = [option for option, value in options.items() if value is not None]
    if opset != OPSET:
        given.append(f"--opset {opset}")
    if given:
        raise GraphError(
            f"{stack} is a trained model of opset {OPSET}: {given[0]} cannot be chosen"
        )
