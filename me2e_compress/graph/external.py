"""Weights in files of their own: where they may lie, and which are read at once."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import onnx_ir as ir

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
        if tensor.nbytes <= SMALL_BYTES or id(tensor) not in mapped:
            replace(_read(anchored, path))
        else:
            replace(anchored)


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
                yield value.const_value, _setter(value)
    for node in nodes_of(model):
        for attribute in node.attributes.values():
            if isinstance(attribute.value, ir.ExternalTensor):
                yield attribute.value, _attribute_setter(node, attribute.name)
            elif attribute.type == ir.AttributeType.TENSORS and not attribute.is_ref():
                for at, tensor in enumerate(attribute.as_tensors()):
                    if isinstance(tensor, ir.ExternalTensor):
                        yield tensor, _item_setter(node, attribute.name, at)


def _setter(value: ir.Value) -> Callable[[ir.TensorProtocol], None]:
    def put(tensor: ir.TensorProtocol) -> None:
        value.const_value = tensor

    return put


def _attribute_setter(node: ir.Node, name: str) -> Callable[[ir.TensorProtocol], None]:
    def put(tensor: ir.TensorProtocol) -> None:
        node.attributes[name] = ir.AttrTensor(name, tensor)

    return put


def _item_setter(
    node: ir.Node, name: str, at: int
) -> Callable[[ir.TensorProtocol], None]:
    def put(tensor: ir.TensorProtocol) -> None:
        tensors = list(node.attributes[name].as_tensors())
        tensors[at] = tensor
        node.attributes[name] = ir.AttrTensors(name, tensors)

    return put


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


def _read(tensor: ir.ExternalTensor, path: Path) -> ir.TensorProtocol:
    try:
        return ir.tensor(tensor.numpy().copy(), dtype=tensor.dtype, name=tensor.name)
    except (ValueError, TypeError) as error:
        raise GraphError(f"{path}: {tensor.name} cannot be read ({error})") from error
