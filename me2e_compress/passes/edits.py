"""The small edits that the exact passes share."""

from collections.abc import Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.graph import provenance, replace_value
from me2e_compress.graph.rewrite import can_replace

Array = npt.NDArray[np.generic]

NATIVE = frozenset(
    {
        ir.DataType.BOOL,
        ir.DataType.DOUBLE,
        ir.DataType.FLOAT,
        ir.DataType.FLOAT16,
        ir.DataType.INT16,
        ir.DataType.INT32,
        ir.DataType.INT64,
        ir.DataType.INT8,
        ir.DataType.UINT16,
        ir.DataType.UINT32,
        ir.DataType.UINT64,
        ir.DataType.UINT8,
    }
)
"""The element types that numpy itself computes with."""

FLOATS = frozenset({ir.DataType.DOUBLE, ir.DataType.FLOAT, ir.DataType.FLOAT16})


def is_standard(node: ir.Node) -> bool:
    """Say whether a node is one of ONNX's own operators."""
    return node.domain in ("", "ai.onnx")


def has_subgraph(node: ir.Node) -> bool:
    """Say whether a node carries a graph of its own (If, Loop, Scan, ...)."""
    kinds = (ir.AttributeType.GRAPH, ir.AttributeType.GRAPHS)
    return any(attribute.type in kinds for attribute in node.attributes.values())


def single_reader(value: ir.Value) -> ir.Node | None:
    """Give the one node that reads a value, once; None if others do, or outputs.

    Nor is it one where it stands in another graph than the value's maker, in the body
    of an If or Loop: that runs seldom, or often, and what it makes stays inside.
    """
    uses = value.uses()
    if len(uses) != 1 or value.is_graph_output():
        return None
    node, made = next(iter(uses)).node, value.producer()
    return node if made is None or made.graph is node.graph else None


def is_read(value: ir.Value) -> bool:
    """Say whether anything needs a value."""
    return bool(value.uses()) or value.is_graph_output()


def put(
    old: ir.Node,
    op_type: str,
    inputs: Sequence[ir.Value | None],
    *,
    by: str,
    sources: Sequence[ir.Node] = (),
    attributes: Mapping[str, int | float | str | Sequence[int]] | None = None,
) -> ir.Node:
    """Put a standard operator in a node's place; it takes over output and name.

    Args:
        old: the node whose first output lives on; it is removed.
        op_type: the operator that takes its place.
        inputs: what it reads.
        by: the pass's name.
        sources: the other nodes it stands for.
        attributes: its attributes.
    """
    graph, result = old.graph, old.outputs[0]
    assert isinstance(graph, ir.Graph)
    new = ir.node(op_type, inputs, attributes, name=old.name, num_outputs=1)
    new.outputs[0].shape, new.outputs[0].type = result.shape, result.type
    new.outputs[0].name = result.name
    provenance.inherit(new, (old, *sources), by=by)
    graph.insert_before(old, new)
    replace_value(result, new.outputs[0])
    graph.remove(old, safe=True)
    return new


def bypass(old: ir.Value, new: ir.Value) -> bool:
    """Let the readers of one value read another, if the interface allows it."""
    if not can_replace(old, new):
        return False
    replace_value(old, new)
    return True


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


def remove_dead(graph: ir.Graph) -> int:
    """Remove the nodes, and the initializers, that nothing reads; count the nodes.

    Initializers go silently where a removed node was their last reader, but those
    that were idle from the start count.
    """
    idle = sum(len(_idle(inner)) for inner in graphs_of(graph))
    count = 0
    for inner in reversed(list(graphs_of(graph))):
        for node in reversed(inner):
            if not any(is_read(value) for value in node.outputs):
                inner.remove(node, safe=True)
                count += 1
    for inner in graphs_of(graph):
        for value in _idle(inner):
            del inner.initializers[value.name or ""]
    return count + idle


def _idle(graph: ir.Graph) -> list[ir.Value]:
    return [
        value
        for value in graph.initializers.values()
        if not is_read(value) and not value.is_graph_input()
    ]
