"""Digests: a number that changes when a graph does."""

import hashlib
import weakref
from collections.abc import Iterable

import numpy as np
import onnx_ir as ir

_TENSORS: "weakref.WeakKeyDictionary[ir.TensorProtocol, bytes]" = (
    weakref.WeakKeyDictionary()
)


def digest(model: ir.Model) -> str:
    """Hash nodes, edges, attributes, weights, metadata and interface, in order."""
    hasher = hashlib.blake2b(digest_size=16)
    hasher.update(repr(sorted(model.opset_imports.items())).encode())
    hasher.update(repr(sorted(model.metadata_props.items())).encode())
    _hash_graph(hasher, model.graph)
    for key in sorted(model.functions, key=str):
        function = model.functions[key]
        hasher.update(repr((key, sorted(function.opset_imports.items()))).encode())
        _hash_nodes(hasher, function)
    return hasher.hexdigest()


def _hash_graph(hasher: "hashlib.blake2b", graph: ir.Graph) -> None:
    for value in (*graph.inputs, *graph.outputs):
        hasher.update(f"{value.name}:{value.type}:{value.shape}\n".encode())
    for name in sorted(graph.initializers):
        hasher.update(f"={name}\n".encode())
        tensor = graph.initializers[name].const_value
        hasher.update(b"?" if tensor is None else digest_of_tensor(tensor))
    _hash_nodes(hasher, graph)


def _hash_nodes(hasher: "hashlib.blake2b", nodes: Iterable[ir.Node]) -> None:
    for node in nodes:
        # Order of inputs and outputs matters, that of metadata does not
        head = (
            node.domain,
            node.op_type,
            node.name,
            [value.name if value is not None else None for value in node.inputs],
            [value.name for value in node.outputs],
            sorted(node.metadata_props.items()),
        )
        hasher.update(repr(head).encode())
        for name in sorted(node.attributes):
            _hash_attribute(hasher, node.attributes[name])


def _hash_attribute(hasher: "hashlib.blake2b", attribute: ir.Attr) -> None:
    hasher.update(f"{attribute.name}/{attribute.type}/".encode())
    if attribute.is_ref():
        hasher.update(f"@{attribute.ref_attr_name}".encode())
    elif attribute.type == ir.AttributeType.GRAPH:
        _hash_graph(hasher, attribute.as_graph())
    elif attribute.type == ir.AttributeType.GRAPHS:
        for graph in attribute.as_graphs():
            _hash_graph(hasher, graph)
    elif attribute.type == ir.AttributeType.TENSOR:
        hasher.update(digest_of_tensor(attribute.value))  # as_tensor() checks it: slow
    elif attribute.type == ir.AttributeType.TENSORS:
        for tensor in attribute.as_tensors():
            hasher.update(digest_of_tensor(tensor))
    else:
        hasher.update(repr(attribute.value).encode())


def digest_of_tensor(tensor: ir.TensorProtocol) -> bytes:
    """Hash type, shape and numbers of a tensor, once for every object."""
    # Clones share tensors: to hash a graph again after a pass costs only the walk over
    # its nodes
    known = _TENSORS.get(tensor)
    if known is None:
        # SHA-256 has processor instructions: half the time of BLAKE2 on weights.
        hasher = hashlib.sha256()
        hasher.update(f"{tensor.dtype}{tensor.shape}".encode())
        if tensor.dtype == ir.DataType.STRING:
            hasher.update(repr(tensor.numpy().tolist()).encode())
        else:
            # A view, not bytes: a mapped weight must not be copied to be hashed.
            flat = np.ascontiguousarray(tensor.numpy()).reshape(-1)
            hasher.update(flat.view(np.uint8).data)
        known = hasher.digest()
        _TENSORS[tensor] = known
    return known
