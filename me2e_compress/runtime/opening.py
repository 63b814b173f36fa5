"""Open a graph in onnxruntime, lending its weights instead of serializing them.

onnxruntime gets the graph without its large weights, as if they were in an external
file, and the arrays in place of that file. So their total size does not matter,
although a protobuf message ends at 2 GiB.
"""

import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime as ort
from onnxruntime.capi import (
    onnxruntime_pybind11_state as _native,  # pyright: ignore[reportAttributeAccessIssue]
)

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.files import INLINE_LIMIT_BYTES
from me2e_compress.graph.nodes import is_read
from me2e_compress.runtime.kernel_types import remedy, without_kernel
from me2e_compress.runtime.providers import CPU, Provider, holds
from me2e_compress.runtime.runnable import runnable, unsupported

# The compiled module has no stubs.


InvalidArgument: type[Exception] = _native.InvalidArgument
"""Raised where inputs do not fit."""

REFUSALS: tuple[type[Exception], ...] = (
    _native.Fail,
    _native.InvalidArgument,
    _native.InvalidGraph,
    _native.InvalidProtobuf,
    _native.NoModel,
    _native.NoSuchFile,
    _native.NotImplemented,
    _native.RuntimeException,
    UnicodeDecodeError,  # a message about names that are not UTF-8
    MemoryError,  # what it computes of constants as it opens is too large
    RuntimeError,  # an output of a type that numpy lacks, such as bfloat16
)
"""Everything raised where a graph cannot be read, built or run."""


_INT8_STAYS = "session.qdqisint8allowed"
LENT_BYTES = 1024
"""Smaller tensors stay in the graph: shape inference reads them."""

Weights: TypeAlias = Mapping[str, ort.OrtValue]
"""Lent weights by name; they must live as long as the session."""

_LENDABLE = frozenset(
    {
        ir.DataType.FLOAT, ir.DataType.DOUBLE, ir.DataType.FLOAT16, ir.DataType.INT8,
        ir.DataType.UINT8, ir.DataType.INT32, ir.DataType.INT64,
    }
)  # fmt: skip


def open_file(
    path: Path,
    options: ort.SessionOptions,
    provider: Provider = CPU,
    without: Sequence[str] | None = None,
) -> tuple[ort.InferenceSession, Weights]:
    """Open an ONNX file directly or, if onnxruntime refuses it, after loading it here.

    This opens graphs that are newer than onnxruntime, that store shapes in a file of
    weights, or that hold fused operators. See :func:`open_graph`.
    """
    if not path.is_file():
        raise GraphError(f"{path}: no such file")
    # Most files open directly: to load one takes ten times as long as to search it.
    if not holds(path, _OWN_NODE, _LOOP):
        try:
            return _build(str(path), options, provider, without), {}
        except GraphError:
            pass
    return open_graph(graph.load(path), options, provider, without)


_OWN_NODE = b":\x04me2e"
"""Bytes of a node in the toolkit's own domain; onnxruntime would run its body."""
_LOOP = b'"\x04Loop'
"""Bytes of a node that may never end."""


def open_graph(
    model: ir.Model,
    options: ort.SessionOptions,
    provider: Provider = CPU,
    without: Sequence[str] | None = None,
) -> tuple[ort.InferenceSession, Weights]:
    """Open a graph in memory, and return its session and its lent weights.

    The weights must live as long as the session, and must not change. The provider is
    attached to ``options``; ``without`` lists optimizations to disable, by default
    those of the provider. The GraphError of a refused graph names the operator.
    """
    if reason := unsupported(model, provider):
        raise GraphError(reason)
    model = runnable(model, options, provider)
    try:
        return _lending(model, options, provider, without)
    except GraphError as refusal:
        raise GraphError(_reason(model, provider) or str(refusal)) from refusal


def _reason(model: ir.Model, provider: Provider) -> str:
    """Say which operator of a refused graph has no kernel; empty if all have one."""
    if provider.native != CPU.native:
        return ""
    typed = model.clone()
    graph.infer_shapes(typed)
    for node, said in without_kernel(typed):
        return f"{said} (node {node.name!r}){remedy(typed, said)}"
    return ""


def _lending(
    model: ir.Model,
    options: ort.SessionOptions,
    provider: Provider,
    without: Sequence[str] | None,
) -> tuple[ort.InferenceSession, Weights]:
    # Lend the large weights that are read.
    lent = {
        name: tensor
        for name, value in model.graph.initializers.items()
        if (tensor := value.const_value) is not None
        and tensor.dtype in _LENDABLE
        and (tensor.nbytes >= LENT_BYTES or isinstance(tensor, ir.ExternalTensor))
        and tensor.nbytes
        and is_read(value)  # onnxruntime drops the others, and then misses them
    }
    # What remains may still be too large for one message.
    if _needs_file(model, lent):
        with tempfile.TemporaryDirectory(prefix="me2e-session-") as folder:
            path = Path(folder) / "model.onnx"
            graph.save(model, path)
            return _build(str(path), options, provider, without), {}
    weights = {
        name: ort.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(tensor.numpy()))
        for name, tensor in lent.items()
    }
    # The arrays stand in for an external file.
    options.add_external_initializers(list(weights), list(weights.values()))
    bare = _without(model, lent).SerializeToString()
    return _build(bare, options, provider, without), weights


def _without(model: ir.Model, lent: Mapping[str, ir.TensorProtocol]) -> onnx.ModelProto:
    """Return a graph with only names, types and shapes of its lent weights."""
    bare = model.clone()
    for name, tensor in lent.items():
        bare.graph.initializers[name].const_value = ir.ExternalTensor(
            "lent",
            0,
            tensor.nbytes,
            tensor.dtype,
            shape=ir.Shape(tensor.shape.numpy()),
            name=name,
        )
    return ir.to_proto(bare)


def _needs_file(model: ir.Model, lent: Mapping[str, ir.TensorProtocol]) -> bool:
    """Return whether the remaining weights are external or exceed one message."""
    kept = [
        tensor
        for each in model.graphs()
        for name, value in each.initializers.items()
        if (tensor := value.const_value) is not None
        and (each is not model.graph or name not in lent)
    ]
    return (
        any(isinstance(tensor, ir.ExternalTensor) for tensor in kept)
        or sum(tensor.nbytes for tensor in kept) > INLINE_LIMIT_BYTES
    )


def _build(
    source: str | bytes,
    options: ort.SessionOptions,
    provider: Provider,
    without: Sequence[str] | None,
) -> ort.InferenceSession:
    """Open a graph; on failure, retry without converting int8 to uint8.

    From opset 21 on, that step of onnxruntime (1.31) leaves QuantizeLinear nodes whose
    ``output_dtype`` is not that of their zero point, and then refuses them.
    """
    left_out = provider.left_out if without is None else without
    try:
        return _opened(source, options, provider, left_out)
    except REFUSALS as error:
        refusal = error
    _keep_int8(options)
    try:
        return _opened(source, options, provider, left_out)
    except REFUSALS:
        line = " ".join(str(refusal).split())
        raise GraphError(f"onnxruntime cannot run this graph: {line}") from refusal


def _keep_int8(options: ort.SessionOptions) -> None:
    """Disable that step; setting the option twice would make onnxruntime warn."""
    try:
        options.get_session_config_entry(_INT8_STAYS)
    except RuntimeError:  # it is not set yet
        options.add_session_config_entry(_INT8_STAYS, "1")


def _opened(
    source: str | bytes,
    options: ort.SessionOptions,
    provider: Provider,
    left_out: Sequence[str],
) -> ort.InferenceSession:
    found = ort.InferenceSession(
        source,
        options,
        providers=provider.chain(),
        disabled_optimizers=list(left_out),
        enable_fallback=False,  # to another provider, with a print
    )
    provider.confirm(found.get_providers())
    return found
