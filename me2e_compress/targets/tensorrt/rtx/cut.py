"""Cut nodes out of a graph that TensorRT-RTX lacks a library for."""

import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.errors import PreconditionError
from me2e_compress.graph.nodes import is_plugin

LACKING = frozenset({"DeformConv", "NonMaxSuppression", "NonZero", "RoiAlign"})
"""Operators that TensorRT supports by its own plugins, and TensorRT-RTX does not."""


def cut(model: ir.Model) -> tuple[ir.Model, tuple[str, ...]]:
    """Cut a graph at plugins: their outputs become inputs, their inputs outputs.

    Nodes with a local function are not plugins: the parser reads the function. Types
    and shapes must be known. Returns the copy, and the names of the nodes that were cut
    out.
    """
    copy = model.clone()
    copy.metadata_props.clear()  # it speaks of inputs and outputs that change
    gone = [node for node in copy.graph if _is_missing(node, copy)]
    names = tuple(node.name or str(node.outputs[0].name) for node in gone)
    for node in gone:
        _detach(copy.graph, node)
    rewrite.sweep(copy)
    return copy, names


def _is_missing(node: ir.Node, model: ir.Model) -> bool:
    if is_plugin(node):
        return node.op_identifier() not in model.functions
    return node.op_type in LACKING


def _detach(where: ir.Graph, node: ir.Node) -> None:
    for value in node.outputs:
        if value.is_graph_output():
            where.outputs.remove(value)
        if not value.uses():
            continue
        # A new graph input needs a type and a shape.
        if value.dtype is None or graph.static_shape(value) is None:
            raise PreconditionError(
                f"{node.op_type} {node.name!r}: the type or shape of its output"
                f" {value.name} is not known, so the graph cannot be cut there"
            )
        name = str(value.name)
        value.name = f"{name}_cut"
        heir = ir.Value(name=name, shape=value.shape, type=value.type)
        value.replace_all_uses_with(heir)
        where.inputs.append(heir)
    # What the node read must still be computed.
    for index, read in enumerate(node.inputs):
        computed = read is not None and read.producer() is not None
        if read is not None and computed and not read.is_graph_output():
            where.outputs.append(read)
        node.replace_input_with(index, None)
    where.remove(node)
