"""Merge what is there twice: equal nodes and equal initializers."""

import hashlib

import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.rewrite import bypass, can_replace, has_subgraph, is_standard

COMMUTATIVE = frozenset({"Add", "And", "Equal", "Mul", "Or", "Xor"})

RANDOM = frozenset(
    {
        "Bernoulli",
        "Dropout",
        "Multinomial",
        "RandomNormal",
        "RandomNormalLike",
        "RandomUniform",
        "RandomUniformLike",
    }
)

EDGE_BYTES = 64
"""How much of each end of a weight is compared before all of it is hashed."""


def share_nodes(graph: ir.Graph, by: str, *, across_modules: bool) -> int:
    """Merge equal nodes into the first of them; count those that went.

    Nodes are equal if operator, attributes and inputs are; those of different
    modules are told apart unless ``across_modules``, so that a module can still be
    taken out later.
    """
    first: dict[object, ir.Node] = {}
    merged: dict[ir.Node, list[ir.Node]] = {}
    for node in graph:
        if not is_standard(node) or node.op_type in RANDOM or has_subgraph(node):
            continue
        module = "" if across_modules else provenance.module_of(node)
        known = first.setdefault(_key(node, module), node)
        if known is node:
            continue
        pairs = list(zip(node.outputs, known.outputs, strict=True))
        if all(can_replace(old, new) for old, new in pairs):
            for old, new in pairs:
                bypass(old, new)
            merged.setdefault(known, [known]).append(node)
    for known, nodes in merged.items():
        provenance.inherit(known, nodes, by=by)
        graph.remove(nodes[1:], safe=True)
    return sum(len(nodes) - 1 for nodes in merged.values())


def _key(node: ir.Node, module: str) -> object:
    inputs = [id(value) for value in node.inputs]
    if node.op_type in COMMUTATIVE:
        inputs.sort()
    attributes = tuple(
        ir.serde.serialize_attribute(node.attributes[name]).SerializeToString(
            deterministic=True
        )
        for name in sorted(node.attributes)
    )
    named = tuple(bool(value.name) for value in node.outputs)
    return (node.op_type, tuple(inputs), named, attributes, module)


def share_initializers(graph: ir.Graph) -> int:
    """Merge equal initializers into the first; count those that went."""
    groups: dict[object, list[ir.Value]] = {}
    for value in graph.initializers.values():
        if value.const_value is not None and not value.is_graph_input():
            groups.setdefault(_edges(value.const_value), []).append(value)
    count = 0
    for group in groups.values():
        first: dict[bytes, ir.Value] = {}
        for value in group if len(group) > 1 else ():
            known = first.setdefault(_content(value), value)
            if known is not value and not value.is_graph_output():
                value.replace_all_uses_with(known)
                del graph.initializers[value.name or ""]
                count += 1
    return count


def _edges(tensor: ir.TensorProtocol) -> object:
    head = (tensor.dtype, tuple(tensor.shape.numpy()))
    if tensor.dtype == ir.DataType.STRING:
        return (*head, tuple(tensor.numpy().reshape(-1).tolist()))
    if tensor.dtype.bitwidth < 8 or tensor.nbytes <= 2 * EDGE_BYTES:
        return (*head, tensor.tobytes())
    flat = tensor.numpy().reshape(-1)
    size = EDGE_BYTES // flat.itemsize
    return (*head, flat[:size].tobytes(), flat[-size:].tobytes())


def _content(value: ir.Value) -> bytes:
    tensor = value.const_value
    if tensor is None or tensor.dtype == ir.DataType.STRING:
        return b""
    return hashlib.blake2b(tensor.tobytes(), digest_size=16).digest()
