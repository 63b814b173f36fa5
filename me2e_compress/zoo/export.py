"""Write a stack of the zoo as ONNX."""

import importlib.util
import logging
import tempfile
import warnings
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import onnx

from me2e_compress.errors import GraphError, MissingExtraError
from me2e_compress.registry.marks import PRODUCER
from me2e_compress.zoo.construct import construct, draw
from me2e_compress.zoo.model_files import write
from me2e_compress.zoo.stacks import TCP, Stack, find

if TYPE_CHECKING:
    from torch import Tensor, nn

    from me2e_compress.zoo.bev.sizes import Sampling
    from me2e_compress.zoo.published_weights import PublishedWeights

GRID_SAMPLE_OPSET = 16
"""The first opset with GridSample; below, sampling is written with Gather."""

FUSED_DOMAIN = "me2e"
"""The domain of fused nodes."""

DYNAMO_OPSET = 18
"""The only opset that torch's dynamo exporter writes as requested; the TorchScript
exporter writes those below."""

OPSETS = range(13, DYNAMO_OPSET + 1)
"""From the first that onnxruntime and TensorRT agree on."""


def export(
    stack: str,
    path: Path,
    *,
    opset: int = 17,
    seed: int = 0,
    heads: str | None = None,
    fused: bool = False,
    weights: "PublishedWeights | None" = None,
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
        MissingExtraError: torch is not installed.
        GraphError: unknown stack or opset, the exporter wrote another opset, or the
            file cannot be written.
    """
    # Refuse what no exporter can write
    spec = find(stack).with_heads(heads)
    if opset not in OPSETS:
        raise GraphError(
            f"cannot export {stack} at opset {opset}: {OPSETS[0]} to {OPSETS[-1]} work"
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
    said = {} if weights is None else weights.record.metadata()
    return save(trace(spec, made, opset), {**spec.metadata(), **said}, path)


def save(graph: onnx.ModelProto, metadata: Mapping[str, str], path: Path) -> Path:
    """Write a traced graph with metadata properties atomically, and return the path."""
    for key, value in metadata.items():
        graph.metadata_props.add(key=key, value=value)
    graph.producer_name, graph.producer_version = PRODUCER, ""
    return write(path, graph.SerializeToString())


def build(
    stack: str,
    *,
    opset: int = 17,
    seed: int = 0,
    heads: str | None = None,
    fused: bool = False,
    weights: "PublishedWeights | None" = None,
) -> "nn.Module":
    """Return the torch module of a stack, with given weights or those of a seed.

    Raises:
        MissingExtraError: torch is not installed.
        GraphError: unknown stack or heads, a stack whose trained weights ship, or
            ``fused`` for one without deformable attention.
    """
    spec = find(stack).with_heads(heads)
    if spec.trained:
        raise GraphError(
            f"{stack} has trained weights, not a seed's: zoo.shipped has its file"
        )
    if importlib.util.find_spec("torch") is None:
        raise MissingExtraError("torch", "zoo")
    if fused and spec.name == TCP.name:
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

    with _quiet_exporter(), torch.no_grad():
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
def _quiet_exporter() -> Iterator[None]:
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "You are using the legacy TorchScript")
        warnings.filterwarnings("ignore", category=DeprecationWarning, module="torch")
        warnings.filterwarnings("ignore", ".*LeafSpec.* is deprecated")
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
