"""Write a reference stack as ONNX."""

import dataclasses
import tempfile
from pathlib import Path

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError, RecipeError
from me2e_compress.graph import file_bytes, rewrite
from me2e_compress.operators import dialect_of, fused_nodes, import_domains, translate
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.passes.fold_constants.knowledge import Sweep
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.workflows.checks import check_count
from me2e_compress.workflows.claims import writing
from me2e_compress.workflows.result import Result, megabytes
from me2e_compress.zoo import export as exporter
from me2e_compress.zoo import shipped
from me2e_compress.zoo.published_weights import PublishedWeights, published_weights
from me2e_compress.zoo.weights_record import WeightsRecord

OPSET = 17
"""Opset of the shipped models, and the default of the others."""


@dataclasses.dataclass(frozen=True)
class ExportOptions:
    """How a stack is written; a trained model has no options.

    Attributes:
        opset: ONNX opset of the file.
        heads: which last layers: ``nuscenes`` or ``bench2drive`` of vad-tiny,
            ``bench2drive`` or ``beta`` of tcp; None is the first.
        seed: seed of the initial weights; None is 0.
        force: replace outputs that we did not write, too.
        dialect: plugin library in whose form deformable attention is one node, or the
            toolkit's own, ``me2e``; None writes it in standard operators.
        weights: checkpoint of the stack's original; None draws weights from the seed.
        ema: take the checkpoint's moving averages (``ema_...``), not its parameters.
    """

    opset: int = OPSET
    heads: str | None = None
    seed: int | None = None
    force: bool = False
    dialect: str | None = None
    weights: Path | None = None
    ema: bool = False

    def __post_init__(self) -> None:
        check_count("--seed", self.seed or 0)
        if self.weights is not None and self.seed is not None:
            raise RecipeError("--seed draws weights, --weights brings them: give one")
        if self.ema and self.weights is None:
            raise RecipeError("--ema needs --weights")
        names = [each.name for each in DeformableAttention().all_dialects()]
        if self.dialect is not None and self.dialect not in names:
            raise RecipeError(
                f"--dialect {self.dialect}: no library of deformable attention; there"
                f" are {', '.join(names)}"
            )


_IMAGES = (
    "images are normalised as hustvl/VAD has it (RGB, ImageNet's); NVIDIA's DL4AGX runs"
    " its VAD-tiny with BGR, mean (103.53, 116.28, 123.675), std 1: for such weights"
    " give those by an adapter (docs/weights.md)"
)
"""A warning about images, which a checkpoint of VAD-tiny may expect in another form."""


@dataclasses.dataclass(frozen=True, repr=False)
class ExportResult(Result):
    """A stack that was written; `weights` is None unless a checkpoint was read."""

    stack: str
    output: Path
    opset: int
    weights: WeightsRecord | None = None

    @property
    def headline(self) -> str:
        """The file, its stack, opset and size."""
        size = megabytes(file_bytes(self.output))
        return f"{self.output}: {self.stack}, opset {self.opset}, {size} MB"

    def lines(self) -> tuple[str, ...]:
        """Return the headline, the checkpoint, and which of its weights are unused."""
        said = () if self.weights is None else self.weights.lines()
        images = (_IMAGES,) if said and self.stack == "vad-tiny" else ()
        return (self.headline, *said, *images)

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
        """Return the file with its stack, opset, bytes and weights."""
        said = None if self.weights is None else dataclasses.asdict(self.weights)
        return {**self.records()[0], "weights": said}


def export_stack(
    stack: str, output: str | Path, options: ExportOptions | None = None
) -> ExportResult:
    """Write a reference stack: random weights, a checkpoint's, or our driver.

    The stack is ``vad-tiny``, ``uniad-tiny``, ``uniad-trt``, ``tcp``, ``highway`` or
    ``highway-2``; the folder of the output is made if needed.

    Raises:
        GraphError: The stack, an option or the output is not usable.
        MissingExtraError: Exporting needs the extra ``zoo``.
    """
    options, output = options or ExportOptions(), Path(output)
    files = [output] if output.parent.is_dir() else []  # else it is made
    given = [] if options.weights is None else [options.weights]
    with writing(files, given, force=options.force):
        # a trained model is copied as it is
        if stack in shipped.SHIPPED:
            _refuse(stack, options)
            shipped.copy(stack, output)
            return ExportResult(stack, output, options.opset)
        return _exported(stack, output, options)


def _exported(stack: str, output: Path, options: ExportOptions) -> ExportResult:
    weights: PublishedWeights | None = None
    if options.weights is not None:
        weights = published_weights(
            stack, options.weights, heads=options.heads, ema=options.ema
        )
    # torch writes our own operator, which is translated to the dialect afterwards
    if options.dialect is not None:
        with tempfile.TemporaryDirectory(prefix="me2e-export-") as folder:
            own = _written(stack, Path(folder, "own.onnx"), options, weights)
            model = in_dialect(graph.load(own), options.dialect)
            output.parent.mkdir(parents=True, exist_ok=True)
            graph.save(model, output)
    else:
        _written(stack, output, options, weights)
    record = None if weights is None else weights.record
    return ExportResult(stack, output, options.opset, record)


def _written(
    stack: str, output: Path, options: ExportOptions, weights: PublishedWeights | None
) -> Path:
    return exporter.export(
        stack,
        output,
        opset=options.opset,
        seed=options.seed or 0,
        heads=options.heads,
        fused=options.dialect is not None,
        weights=weights,
    )


def in_dialect(model: ir.Model, dialect: str) -> ir.Model:
    """Write the fused nodes of a graph in a dialect, with the shapes of their outputs.

    A dialect that cannot express one of them raises PreconditionError.
    """
    _record_shapes(model)
    # plugins tell no shapes, so that these were recorded above
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
    # fold and infer in a copy until no more shapes become known
    copy = model.clone()
    rewrite.lift_constants(copy)
    left, before = _unshaped(copy), -1
    while left != before:
        before = left
        graph.infer_shapes(copy)
        sweep = Sweep(
            graph.opset_of(copy), set(), set(), through_compute=False, trust_shapes=True
        )
        sweep.run(copy.graph)
        left = _unshaped(copy)
    # write the shapes back, by name
    known = {value.name: value for node in copy.graph for value in node.outputs}
    for node in model.graph:
        for value in node.outputs:
            found = known.get(value.name)
            if found is not None and not value.is_graph_output():
                value.shape, value.type = found.shape, found.type


def _unshaped(model: ir.Model) -> int:
    values = (value for node in model.graph for value in node.outputs)
    return sum(graph.static_shape(value) is None for value in values)


def _refuse(stack: str, options: ExportOptions) -> None:
    """Refuse options that a trained model, one file, does not have."""
    chosen = {
        "--seed": options.seed is not None,
        "--heads": options.heads is not None,
        "--weights": options.weights is not None,
        "--dialect": options.dialect is not None,
        f"--opset {options.opset}": options.opset != OPSET,
    }
    given = [option for option, is_given in chosen.items() if is_given]
    if given:
        raise GraphError(
            f"{stack} is a trained model of opset {OPSET}: {given[0]} cannot be chosen"
        )
