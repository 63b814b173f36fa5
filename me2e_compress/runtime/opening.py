"""Open a graph as an onnxruntime session, its weights lent, not written out.

What onnxruntime is given is the graph without its large weights, as if they lay in a
file, and the arrays themselves in the place of that file. So no weight is serialized,
however large they are together (a protobuf message ends at 2 GiB).
"""

import tempfile
from collections.abc import Mapping
from pathlib import Path
from typing import TypeAlias

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime as ort

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.files import INLINE_LIMIT_BYTES
from me2e_compress.runtime.native import REFUSALS, unsupported

_INT8_STAYS = "session.qdqisint8allowed"
LENT_BYTES = 1024
"""Smaller tensors are left in the graph: shape inference reads those."""

Weights: TypeAlias = Mapping[str, ort.OrtValue]
"""Lent weights by name; they must live as long as the session."""

_LENDABLE = frozenset(
    {
        ir.DataType.FLOAT, ir.DataType.DOUBLE, ir.DataType.FLOAT16, ir.DataType.INT8,
        ir.DataType.UINT8, ir.DataType.INT32, ir.DataType.INT64,
    }
)  # fmt: skip


def open_file(path: Path, options: ort.SessionOptions) -> ort.InferenceSession:
    """Open an ONNX file.

    Raises:
        GraphError: no such file, or onnxruntime cannot run it.
    """
    if not path.is_file():
        raise GraphError(f"{path}: no such file")
    return _build(str(path), options)


def open_graph(
    model: ir.Model, options: ort.SessionOptions
) -> tuple[ort.InferenceSession, Weights]:
    """Open a graph in memory.

    Args:
        model: the graph; it stays as it is, and its weights are not to be changed
            while the session lives.
        options: of the session.

    Returns:
        The session, and what must live as long.

    Raises:
        GraphError: onnxruntime cannot run this graph; the message names the operator.
    """
    if reason := unsupported(model):
        raise GraphError(reason)
    lent = {
        name: tensor
        for name, value in model.graph.initializers.items()
        if (tensor := value.const_value) is not None
        and tensor.dtype in _LENDABLE
        and (tensor.nbytes >= LENT_BYTES or isinstance(tensor, ir.ExternalTensor))
        and tensor.nbytes
    }
    if _needs_file(model, lent):
        with tempfile.TemporaryDirectory(prefix="me2e-session-") as folder:
            path = Path(folder) / "model.onnx"
            graph.save(model, path)
            return _build(str(path), options), {}
    weights = {
        name: ort.OrtValue.ortvalue_from_numpy(np.ascontiguousarray(tensor.numpy()))
        for name, tensor in lent.items()
    }
    options.add_external_initializers(list(weights), list(weights.values()))
    return _build(_without(model, lent).SerializeToString(), options), weights


def _without(model: ir.Model, lent: Mapping[str, ir.TensorProtocol]) -> onnx.ModelProto:
    """Write a graph, of its lent weights only names, types and shapes."""
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
    """Return whether what is not lent lies in files, or fits no single message."""
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


def _build(source: str | bytes, options: ort.SessionOptions) -> ort.InferenceSession:
    """Open a graph; where that fails, again without the step that makes int8 uint8.

    From opset 21 on, that step of onnxruntime (1.31) leaves QuantizeLinear nodes whose
    ``output_dtype`` is not that of their zero point, and then refuses them.
    """
    providers = ["CPUExecutionProvider"]
    try:
        return ort.InferenceSession(source, options, providers=providers)
    except REFUSALS as error:
        refusal = error
    options.add_session_config_entry(_INT8_STAYS, "1")
    try:
        return ort.InferenceSession(source, options, providers=providers)
    except REFUSALS:
        line = " ".join(str(refusal).split())
        raise GraphError(f"onnxruntime cannot run this graph: {line}") from refusal
