"""Weights on disk: in files of their own, or in the file of the graph.

Of those in files of their own some are read at once, and the others mapped. A file
with all weights inside is written one weight at a time: `onnx.save` holds them three
times, in the graph, in the message and in its bytes. Here they are held once; the
bytes of the file are the same.
"""

import os
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import partial
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
from google.protobuf.message import Message

from me2e_compress.errors import GraphError
from me2e_compress.graph.nodes import nodes_of

SMALL_BYTES = 1024
"""Weights up to this size are read at once: shapes and axes are among them, and
ONNX's checker would look for their file in the working directory."""


def external_tensors(model: ir.Model) -> Iterator[ir.ExternalTensor]:
    """List the weights whose data lie in a file of their own."""
    for tensor, _ in _places(model):
        yield tensor


def settle(model: ir.Model, path: Path) -> None:
    """Check where external weights lie, and read those that must not stay on disk.

    The large initializers of the main graph stay, mapped from a path that holds in
    any working directory. Read are small ones, those of subgraphs and tensors in
    attributes.

    Raises:
        GraphError: a tensor's file is missing, too short, or outside the model's
            folder.
    """
    mapped = {id(value.const_value) for value in model.graph.initializers.values()}
    for tensor, replace in list(_places(model)):
        anchored = _anchored(tensor, path)
        if tensor.nbytes > SMALL_BYTES and id(tensor) in mapped:
            replace(anchored)
            continue
        try:
            array = anchored.numpy().copy()
            replace(ir.tensor(array, dtype=tensor.dtype, name=tensor.name))
        except (ValueError, TypeError) as error:
            message = f"{path}: {tensor.name} cannot be read ({error})"
            raise GraphError(message) from error


def data_file(model: Path, tensor: ir.ExternalTensor) -> Path:
    """Find the file with the data of a tensor, links resolved.

    The rule is onnxruntime's: a relative path, and a link must stay in the model's
    folder, or lead to where the model itself is a link to (a hub's cache).

    Raises:
        GraphError: the path is absolute or leads elsewhere.
    """
    location = str(tensor.location)
    if os.path.isabs(location) or not location or "\0" in location:
        raise GraphError(
            f"{model}: the data of {tensor.name} lie at {location!r}, which is not a"
            " path within the model's folder: not read"
        )
    found = Path(os.path.realpath(model.parent / location))
    homes = (os.path.realpath(model.parent), Path(os.path.realpath(model)).parent)
    if not any(found.is_relative_to(each) for each in homes):
        raise GraphError(
            f"{model}: the data of {tensor.name} lie at {location!r} = {found}, outside"
            " the model's folder: not read"
        )
    return found


def _places(
    model: ir.Model,
) -> Iterator[tuple[ir.ExternalTensor, Callable[[ir.TensorProtocol], None]]]:
    """List external tensors, each with the function that puts another in its place."""
    for graph in model.graphs():
        for value in graph.initializers.values():
            if isinstance(value.const_value, ir.ExternalTensor):
                yield value.const_value, partial(setattr, value, "const_value")
    for node in nodes_of(model):
        for attribute in node.attributes.values():
            if isinstance(attribute.value, ir.ExternalTensor):
                yield attribute.value, partial(_put, node, attribute.name, None)
            elif attribute.type == ir.AttributeType.TENSORS and not attribute.is_ref():
                for at, tensor in enumerate(attribute.as_tensors()):
                    if isinstance(tensor, ir.ExternalTensor):
                        yield tensor, partial(_put, node, attribute.name, at)


def _put(node: ir.Node, name: str, at: int | None, tensor: ir.TensorProtocol) -> None:
    """Put a tensor into an attribute, or into one place of its list."""
    if at is None:
        node.attributes[name] = ir.AttrTensor(name, tensor)
        return
    tensors = list(node.attributes[name].as_tensors())
    tensors[at] = tensor
    node.attributes[name] = ir.AttrTensors(name, tensors)


def _anchored(tensor: ir.ExternalTensor, path: Path) -> ir.ExternalTensor:
    """Return a tensor whose file is there, long enough and named absolutely."""
    data = data_file(path, tensor)
    if not data.is_file():
        missing = path.parent / str(tensor.location)
        raise GraphError(f"{path}: its weights file {missing} is missing")
    found = data.stat()
    end = (tensor.offset or 0) + max(tensor.length or 0, tensor.nbytes)
    if found.st_size < end:
        raise GraphError(
            f"{path}: {data} is cut short: {tensor.name} ends at byte {end},"
            f" the file at {found.st_size}"
        )
    if found.st_nlink > 1:  # what onnx and onnx-ir refuse to read
        raise GraphError(
            f"{path}: the data of {tensor.name} lie in {data}, a file with"
            f" {found.st_nlink} hard links, which onnx refuses: copy it"
        )
    return ir.ExternalTensor(
        data.name,
        tensor.offset,
        tensor.length,
        tensor.dtype,
        shape=ir.Shape(tensor.shape.numpy()),
        name=tensor.name,
        doc_string=tensor.doc_string,
        base_dir=data.parent,
    )


LARGE_BYTES = 1 << 16
"""Weights beyond this are written one by one, smaller ones with the graph."""

_GRAPH, _INITIALIZER, _RAW_DATA = b"\x3a", b"\x2a", b"\x4a"
"""ModelProto.graph is field 7, GraphProto.initializer 5, TensorProto.raw_data 9, each
followed by its length (onnx.proto)."""

_BEFORE_GRAPH = (
    *("ir_version", "producer_name", "producer_version", "domain"),
    *("model_version", "doc_string"),
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
    """Write a model with all its weights in one file; none of them is external.

    The model stays as it is.
    """
    large = {
        value: value.const_value
        for value in model.graph.initializers.values()
        if value.const_value is not None and _is_large(value.const_value)
    }
    proto = _light(model, large)
    # The message of each weight, that of a large one but for its numbers
    large_of = {str(value.name): tensor for value, tensor in large.items()}
    weights = list[tuple[bytes, ir.TensorProtocol | None, int]]()
    for each in proto.graph.initializer:
        tensor = large_of.get(each.name)
        if tensor is None:
            begin, more = bytes(each.SerializeToString()), 0
        else:
            begin, more = _begin(each.name, tensor), tensor.nbytes
        weights.append((begin, tensor, len(begin) + more))
    # Fields are written in the order of their numbers
    proto.graph.ClearField("initializer")
    before, behind = _around(proto.graph, ("node", "name"))
    proto.ClearField("graph")
    first, last = _around(proto, _BEFORE_GRAPH)
    total = sum(1 + len(_varint(length)) + length for _, _, length in weights)
    total += len(before) + len(behind)
    with path.open("wb") as stream:
        stream.write(first + _GRAPH + _varint(total) + before)
        for begin, tensor, length in weights:
            stream.write(_INITIALIZER + _varint(length) + begin)
            if tensor is not None:
                stream.write(tensor.tobytes())
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


def _around(message: Message, fields_before: Iterable[str]) -> tuple[bytes, bytes]:
    """Return the fields of a message before one that it lacks, and those behind."""
    whole = message.SerializeToString()
    for name in fields_before:
        message.ClearField(name)
    behind = message.SerializeToString()
    return whole[: len(whole) - len(behind)], behind


def _varint(number: int) -> bytes:
    """Write a number as protobuf does: seven bits a byte, the last without a mark."""
    parts = list[int]()
    while number > 0x7F:
        parts.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes([*parts, number])
