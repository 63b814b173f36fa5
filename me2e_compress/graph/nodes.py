"""Facts about single nodes and values."""

from collections.abc import Iterator

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

STANDARD = ("", "ai.onnx")
"""The two spellings of the domain of ONNX's own operators."""


def is_standard(node: ir.Node) -> bool:
    """Return whether a node is one of ONNX's own operators."""
    return node.domain in STANDARD


def opset_of(imports: ir.Model | ir.Function) -> int:
    """Return the opset of ONNX's own operators that is imported; 0 if none is."""
    found = imports.opset_imports
    return next((found[domain] for domain in STANDARD if domain in found), 0)


def nodes_of(model: ir.Model) -> Iterator[ir.Node]:
    """Walk the nodes of the graph, of its bodies and of its functions."""
    yield from model.graph.all_nodes()
    for function in model.functions.values():
        yield from function.all_nodes()


def input_at(node: ir.Node, index: int) -> ir.Value | None:
    """Return an input of a node; None if it is left out."""
    return node.inputs[index] if index < len(node.inputs) else None


def producer_of(value: ir.Value | None) -> ir.Node | None:
    """Return the node that computes a value; None for inputs and initializers."""
    return None if value is None else value.producer()


def has_subgraph(node: ir.Node) -> bool:
    """Return whether a node carries a graph of its own (If, Loop, Scan, ...)."""
    kinds = (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)
    return any(attribute.type in kinds for attribute in node.attributes.values())


def graphs_of(graph: ir.Graph) -> Iterator[ir.Graph]:
    """Walk a graph and all the graphs inside its nodes, outermost first."""
    yield graph
    for node in graph:
        for attribute in node.attributes.values():
            if attribute.type == ir.AttributeType.GRAPH:
                yield from graphs_of(attribute.as_graph())
            elif attribute.type == ir.AttributeType.GRAPHS:
                for inner in attribute.as_graphs():
                    yield from graphs_of(inner)


def array_of(value: ir.Value | None) -> npt.NDArray[np.generic] | None:
    """Return the array of an initializer or Constant; None if the value is computed."""
    if value is None or value.is_graph_input():
        return None
    if value.const_value is not None and value.is_initializer():
        return value.const_value.numpy()
    if value.producer() is None:
        return None
    tensor = ir.convenience.get_const_tensor(value)
    return None if tensor is None else tensor.numpy()
