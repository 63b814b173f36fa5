"""Write a reference stack as ONNX.

    python -m models.export uniad-tiny -o M.onnx

Options: ``--opset``, ``--seed``, ``--heads``, ``--dialect``, ``--weights``, ``--ema``
and ``--force``.
"""

import argparse
import logging
import sys
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import onnx

from me2e_compress import graph
from me2e_compress.base.atomic import PRODUCER
from me2e_compress.base.display import format_mb
from me2e_compress.base.errors import GraphError, Me2eError, RecipeError
from me2e_compress.commands.checks import writing
from me2e_compress.commands.inspect import WEIGHTS
from me2e_compress.commands.options import check_count
from me2e_compress.graph import file_bytes
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.shipped.drivers import write_model_file
from models.construct import construct, draw
from models.dialect import in_dialect
from models.published_weights import PublishedWeights, published_weights
from models.stacks import STACKS, Stack, find

if TYPE_CHECKING:
    from torch import Tensor, nn

    from models.bev.sizes import Sampling

GRID_SAMPLE_OPSET = 16
"""The first opset with GridSample; below, sampling is written with Gather."""

FUSED_DOMAIN = "me2e"
"""The domain of fused nodes."""

DYNAMO_OPSET = 18
"""The only opset that torch's dynamo exporter writes as requested; the TorchScript
exporter writes those below."""

OPSET = 17
"""The default."""

OPSETS = range(13, DYNAMO_OPSET + 1)
"""From the first that onnxruntime and TensorRT agree on."""


def export(
    stack: str,
    path: Path,
    *,
    opset: int = OPSET,
    seed: int = 0,
    heads: str | None = None,
    fused: bool = False,
    weights: PublishedWeights | None = None,
) -> Path:
    """Build a stack from a seed or a checkpoint and write it as one ONNX file.

    Parameters keep their state-dict names and nodes the scopes of their modules, which
    module maps read; constants are not folded. The metadata describe the file
    (`Stack.metadata`). Returns the path.

    Args:
        stack: a name in `STACKS`.
        path: the ``.onnx`` to write, atomically.
        opset: 13 to 18; below 16 grid sampling is decomposed into gathers, and 18 is
            written by the dynamo exporter.
        seed: of all weights, unless they are given.
        heads: which last layers; None is the default of the stack.
        fused: whether deformable attention is one node, of the domain ``me2e``.
        weights: of the stack with these heads; the metadata name their file.

    Raises:
        GraphError: unknown stack or opset, the exporter wrote another opset, or the
            file cannot be written.
    """
    # Refuse what no exporter can write
    spec = find(stack).with_heads(heads)
    least = max(OPSETS[0], spec.least_opset)
    if opset not in OPSETS[least - OPSETS[0] :]:
        raise GraphError(
            f"cannot export {stack} at opset {opset}: {least} to {OPSETS[-1]} work"
        )
    if fused and opset == DYNAMO_OPSET:
        raise GraphError(
            f"cannot export {stack} at opset {opset} with plugins, which take up to"
            f" {DYNAMO_OPSET - 1}"
        )
    # Build, trace, and save
    made = build(
        stack, opset=opset, seed=seed, heads=heads, fused=fused, weights=weights
    )
    said = {WEIGHTS: "random"} if weights is None else weights.record.metadata()
    return save(trace(spec, made, opset), {**spec.metadata(), **said}, path)


def save(graph: onnx.ModelProto, metadata: Mapping[str, str], path: Path) -> Path:
    """Write a traced graph with metadata properties atomically, and return the path."""
    for key, value in metadata.items():
        graph.metadata_props.add(key=key, value=value)
    graph.producer_name, graph.producer_version = PRODUCER, ""
    return write_model_file(path, graph.SerializeToString())


def build(
    stack: str,
    *,
    opset: int = OPSET,
    seed: int = 0,
    heads: str | None = None,
    fused: bool = False,
    weights: PublishedWeights | None = None,
) -> "nn.Module":
    """Return the torch module of a stack, with given weights or those of a seed.

    Raises:
        GraphError: unknown stack or heads, or ``fused`` for one without deformable
            attention.
    """
    spec = find(stack).with_heads(heads)
    if fused and spec.sees != "surround":
        raise GraphError(f"{stack} has no deformable attention: no plugin fits it")
    # The opset decides how features are sampled
    native: Sampling = "operator" if opset >= GRID_SAMPLE_OPSET else "gather"
    sampling = "fused" if fused else native
    if weights is None:
        return draw(spec, sampling, seed)
    model = construct(spec, sampling)
    weights.fill(model)
    return model


def trace(spec: Stack, model: "nn.Module", opset: int) -> onnx.ModelProto:
    """Trace a module with example inputs and return the graph."""
    import torch

    with _quiet_exporter(), _written_out(), torch.no_grad():
        write_graph = _by_dynamo if opset == DYNAMO_OPSET else _by_torchscript
        graph = write_graph(spec, model, opset)
    written = {entry.domain: entry.version for entry in graph.opset_import}
    if written not in ({"": opset}, {"": opset, FUSED_DOMAIN: 1}):
        raise GraphError(f"{spec.name}: asked for opset {opset}, torch wrote {written}")
    return graph


def _by_torchscript(spec: Stack, model: "nn.Module", opset: int) -> onnx.ModelProto:
    import torch

    with tempfile.TemporaryDirectory(prefix="me2e-trace-") as folder:
        file = Path(folder) / "traced.onnx"
        torch.onnx.export(
            model,
            example(spec),
            file,
            dynamo=False,
            opset_version=opset,
            do_constant_folding=False,
            input_names=list(spec.inputs),
            output_names=list(spec.outputs),
        )
        return onnx.load(file)


def _by_dynamo(spec: Stack, model: "nn.Module", opset: int) -> onnx.ModelProto:
    """Scopes are in the nodes' metadata; the exporter's own passes are skipped."""
    import torch

    program = torch.onnx.export(
        model,
        example(spec),
        dynamo=True,
        opset_version=opset,
        input_names=list(spec.inputs),
        output_names=list(spec.outputs),
        optimize=False,
        verbose=False,
    )
    if program is None:
        raise GraphError(f"{spec.name}: torch wrote no graph of opset {opset}")
    return program.model_proto


def example(spec: Stack) -> "tuple[Tensor, ...]":
    """Return zeros in the shapes and types of the inputs, which suffice for a trace."""
    import torch

    types = {"float32": torch.float32, "int64": torch.int64}
    return tuple(
        torch.zeros(shape, dtype=types[spec.dtypes.get(name, "float32")])
        for name, shape in spec.inputs.items()
    )


@contextmanager
def _written_out() -> Iterator[None]:
    """Keep torch's attention from its one operator for inference, which ONNX lacks."""
    import torch

    fast = torch.backends.mha.get_fastpath_enabled()
    torch.backends.mha.set_fastpath_enabled(False)
    try:
        yield
    finally:
        torch.backends.mha.set_fastpath_enabled(fast)


@contextmanager
def _quiet_exporter() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "You are using the legacy TorchScript")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
        warnings.filterwarnings("ignore", ".*LeafSpec.* is deprecated")
        # Sizes and widths, which are fixed
        fixed = "Converting a tensor to a Python"
        for module in (r"models\.lead", r"torch\.nn\.functional"):
            warnings.filterwarnings("ignore", fixed, module=module)
        with _quiet_registry():
            yield


@contextmanager
def _quiet_registry() -> Iterator[None]:
    """Silence the dynamo exporter's warning about torchvision, which no stack uses."""
    log = logging.getLogger("torch.onnx._internal.exporter._registration")
    level = log.level
    log.setLevel(logging.ERROR)
    try:
        yield
    finally:
        log.setLevel(level)


@dataclass(frozen=True)
class ExportOptions:
    """How a stack is written.

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
        """Check what contradicts."""
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


IMAGES = (
    "images are normalised as hustvl/VAD has it (RGB, ImageNet's); NVIDIA's DL4AGX runs"
    " its VAD-tiny with BGR, mean (103.53, 116.28, 123.675), std 1: for such weights"
    " give those by an adapter (models/README.md)"
)
"""A warning about images, which a checkpoint of VAD-tiny may expect in another form."""


def export_stack(
    stack: str, output: Path, options: ExportOptions | None = None
) -> tuple[str, ...]:
    """Write a stack as the command does, and return the lines that it prints.

    Raises:
        GraphError: The stack, an option, the checkpoint or the output is not usable.
    """
    options = options or ExportOptions()
    files = [output] if output.parent.is_dir() else []  # else it is made
    given = [] if options.weights is None else [options.weights]
    with writing(files, given, force=options.force):
        weights = None
        if options.weights is not None:
            weights = published_weights(
                stack, options.weights, heads=options.heads, ema=options.ema
            )
        _written(stack, output, options, weights)
    size = format_mb(file_bytes(output))
    line = f"{output}: {stack}, opset {options.opset}, {size} MB"
    said = () if weights is None else weights.record.lines()
    return (line, *said, *((IMAGES,) if said and stack == "vad-tiny" else ()))


def _written(
    stack: str,
    output: Path,
    options: ExportOptions,
    weights: PublishedWeights | None,
) -> None:
    """Write our own operator first, and translate it to the dialect afterwards."""
    with tempfile.TemporaryDirectory(prefix="me2e-export-") as folder:
        traced = output if options.dialect is None else Path(folder, "own.onnx")
        export(
            stack,
            traced,
            opset=options.opset,
            seed=options.seed or 0,
            heads=options.heads,
            fused=options.dialect is not None,
            weights=weights,
        )
        if options.dialect is not None:
            model = in_dialect(graph.load(traced), options.dialect)
            output.parent.mkdir(parents=True, exist_ok=True)
            graph.save(model, output)


def main() -> None:
    """Run the command."""
    parser = argparse.ArgumentParser(prog="python -m models.export")
    add = parser.add_argument
    add("stack", help=", ".join(STACKS))
    add("-o", "--output", type=Path, required=True, help="the ONNX file")
    add("--opset", type=int, default=OPSET, help="13 to 18; 18 by torch's dynamo")
    add("--heads", help="vad-tiny: nuscenes, bench2drive; tcp: bench2drive, beta")
    add("--seed", type=int, help="of the weights; default 0")
    add("--dialect", help="deformable attention as one node of this plugin library")
    add("--weights", type=Path, help="a checkpoint of the original")
    add("--ema", action="store_true", help="the moving averages of --weights")
    add("--force", action="store_true", help="replace what is there")
    given = vars(parser.parse_args())
    stack, output = given.pop("stack"), given.pop("output")
    try:
        print(*export_stack(stack, output, ExportOptions(**given)), sep="\n")
    except Me2eError as error:
        sys.exit(f"models.export: {error}")


if __name__ == "__main__":
    main()
