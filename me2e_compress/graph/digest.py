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
    """Hash nodes, edges, attributes, weights, metadata and interface, in order.

    Weights are hashed once per tensor object: clones share them, so hashing a graph
    again after a pass costs only the walk over its nodes.
    """
    seal = hashlib.blake2b(digest_size=16)
    seal.update(repr(sorted(model.opset_imports.items())).encode())
    seal.update(repr(sorted(model.metadata_props.items())).encode())
    _graph(seal, model.graph)
    for key in sorted(model.functions, key=str):
        seal.update(repr(key).encode())
        _nodes(seal, model.functions[key])
    return seal.hexdigest()


def _graph(seal: "hashlib.blake2b", graph: ir.Graph) -> None:
    for value in (*graph.inputs, *graph.outputs):
        seal.update(f"{value.name}:{value.type}:{value.shape}\n".encode())
    for name in sorted(graph.initializers):
        seal.update(f"={name}\n".encode())
        tensor = graph.initializers[name].const_value
        seal.update(b"?" if tensor is None else _tensor(tensor))
    _nodes(seal, graph)


def _nodes(seal: "hashlib.blake2b", nodes: Iterable[ir.Node]) -> None:
    for node in nodes:
        head = (
            node.domain,
            node.op_type,
            node.name,
            [value.name if value is not None else None for value in node.inputs],
            [value.name for value in node.outputs],
            sorted(node.metadata_props.items()),
        )
        seal.update(repr(head).encode())
        for name in sorted(node.attributes):
            _attribute(seal, node.attributes[name])


def _attribute(seal: "hashlib.blake2b", attribute: ir.Attr) -> None:
    seal.update(f"{attribute.name}/{attribute.type}/".encode())
    if attribute.is_ref():
        seal.update(f"@{attribute.ref_attr_name}".encode())
    elif attribute.type == ir.AttributeType.GRAPH:
        _graph(seal, attribute.as_graph())
    elif attribute.type == ir.AttributeType.GRAPHS:
        for graph in attribute.as_graphs():
            _graph(seal, graph)
    elif attribute.type == ir.AttributeType.TENSOR:
        seal.update(_tensor(attribute.value))  # as_tensor() checks a protocol: slow
    elif attribute.type == ir.AttributeType.TENSORS:
        for tensor in attribute.as_tensors():
            seal.update(_tensor(tensor))
    else:
        seal.update(repr(attribute.value).encode())


def _tensor(tensor: ir.TensorProtocol) -> bytes:
    known = _TENSORS.get(tensor)
    if known is None:
        # SHA-256 has processor instructions: half the time of BLAKE2 on weights.
        seal = hashlib.sha256()
        seal.update(f"{tensor.dtype}{tensor.shape}".encode())
        if tensor.dtype == ir.DataType.STRING:
            seal.update(repr(tensor.numpy().tolist()).encode())
        else:
            # A view, not bytes: a mapped weight must not be copied to be hashed.
            flat = np.ascontiguousarray(tensor.numpy()).reshape(-1)
            seal.update(flat.view(np.uint8).data)
        known = seal.digest()
        _TENSORS[tensor] = known
    return known
