"""An ONNX file with its weights inside, written one weight at a time.

`onnx.save` holds the weights three times: in the graph, in the message and in its
bytes. Here they are held once; the bytes of the file are the same.
"""

from collections.abc import Mapping
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir

LARGE_BYTES = 1 << 16
"""Weights beyond this are written one by one, smaller ones with the graph."""

_GRAPH, _INITIALIZER, _RAW_DATA = b"\x3a", b"\x2a", b"\x4a"
"""ModelProto.graph is field 7, GraphProto.initializer 5, TensorProto.raw_data 9, each
followed by its length (onnx.proto)."""

_BEHIND_GRAPH = (
    *("opset_import", "metadata_props", "training_info", "functions"),
    "configuration",
)
_PLAIN = frozenset(
    {
        *(ir.DataType.FLOAT, ir.DataType.DOUBLE, ir.DataType.FLOAT16),
        *(ir.DataType.INT64, ir.DataType.INT32, ir.DataType.INT8),
        *(ir.DataType.UINT8, ir.DataType.BOOL),
    }
)
"""Types whose raw bytes are those of the numbers."""


def write_inline(model: ir.Model, path: Path) -> None:
    """Write a model with all its weights in one file.

    Args:
        model: with no weights in files of their own; it stays as it is.
        path: the file.
    """
    large = {
        value: value.const_value
        for value in model.graph.initializers.values()
        if value.const_value is not None and _is_large(value.const_value)
    }
    proto = _light(model, large)
    of_name = {str(value.name): tensor for value, tensor in large.items()}
    begins, lengths = list[bytes](), list[int]()
    for each in proto.graph.initializer:
        held = of_name.get(each.name)
        begin = each.SerializeToString() if held is None else _begin(each.name, held)
        begins.append(begin)
        lengths.append(len(begin) + (0 if held is None else held.nbytes))
    total = sum(1 + len(_varint(length)) + length for length in lengths)
    names = [each.name for each in proto.graph.initializer]
    before, behind = _graph_around(proto.graph)
    first, last = _model_around(proto)
    total += len(before) + len(behind)
    with path.open("wb") as stream:
        stream.write(first + _GRAPH + _varint(total) + before)
        for name, begin, length in zip(names, begins, lengths, strict=True):
            stream.write(_INITIALIZER + _varint(length) + begin)
            if name in of_name:
                stream.write(of_name[name].tobytes())
        stream.write(behind + last)


def _is_large(tensor: ir.TensorProtocol) -> bool:
    if isinstance(tensor, ir.serde.TensorProtoTensor):
        held: onnx.TensorProto = tensor.raw
        if not held.HasField("raw_data"):  # numbers as a list stay a list
            return False
    return (
        tensor.nbytes > LARGE_BYTES
        and tensor.dtype in _PLAIN
        and not tensor.doc_string
        and not tensor.metadata_props
        and not isinstance(tensor, ir.ExternalTensor)
    )


def _light(
    model: ir.Model, large: Mapping[ir.Value, ir.TensorProtocol]
) -> onnx.ModelProto:
    """Write the message of a model, its large weights empty."""
    try:
        for value in large:
            value.const_value = ir.tensor(np.zeros(0, np.float32), name=value.name)
        return ir.to_proto(model)
    finally:
        for value, tensor in large.items():
            value.const_value = tensor


def _begin(name: str, tensor: ir.TensorProtocol) -> bytes:
    """Return all of a tensor's message but the numbers; its name is the value's."""
    begin = onnx.TensorProto(
        dims=[int(size) for size in tensor.shape.numpy()],
        data_type=tensor.dtype.value,
        name=name,
    )
    return bytes(begin.SerializeToString()) + _RAW_DATA + _varint(tensor.nbytes)


def _graph_around(graph: onnx.GraphProto) -> tuple[bytes, bytes]:
    """Return the fields of a graph before its initializers, and those behind.

    Fields are written in the order of their numbers: nodes and name come before.
    """
    graph.ClearField("initializer")
    whole = graph.SerializeToString()
    graph.ClearField("node")
    graph.ClearField("name")
    behind = graph.SerializeToString()
    return whole[: len(whole) - len(behind)], behind


def _model_around(proto: onnx.ModelProto) -> tuple[bytes, bytes]:
    """Return the fields of a model before its graph, and those behind."""
    proto.ClearField("graph")
    whole = proto.SerializeToString()
    for name in _BEHIND_GRAPH:
        proto.ClearField(name)
    first = proto.SerializeToString()
    return first, whole[len(first) :]


def _varint(number: int) -> bytes:
    """Write a number as protobuf does: seven bits a byte, the last without a mark."""
    parts = list[int]()
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])
