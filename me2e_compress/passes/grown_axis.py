"""Propagate the size of an axis that grew through the rest of a graph."""

import math

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import rewrite
from me2e_compress.graph.node_inference import REFUSALS, infer_node
from me2e_compress.passes.parts import listed


def carry(model: ir.Model, grown: ir.Value, old: ir.Value, what: str) -> None:
    """Infer the shapes behind a value that grew along one axis, in place.

    A Reshape gets a new constant shape. Raises PreconditionError where an operator or a
    graph output does not take the new size. ``what`` describes the change in messages.
    """
    # Visit, in order, only nodes that read a grown value
    was = {grown: graph.static_shape(old) or ()}
    for node in model.graph:
        if not any(value in was for value in node.inputs if value is not None):
            continue
        if node.op_type == "Reshape":
            _reshape(model.graph, node, was, what)
        shapes = _inferred(model, node, what)
        for value in node.outputs:
            # A shape may change only where it stays known and internal
            before, after = graph.static_shape(value), shapes.get(str(value.name))
            if before == after or not value.name:
                continue
            if after is None or before is None or value.is_graph_output():
                raise PreconditionError(f"{what} would change {listed([value])}")
            was[value], value.shape = before, ir.Shape(after)


def _reshape(
    where: ir.Graph,
    node: ir.Node,
    was: dict[ir.Value, tuple[int, ...]],
    what: str,
) -> None:
    """Update a constant shape; the grown axis must be neither split nor merged."""
    # The shapes before and after must be known
    source, size = node.inputs[0], node.inputs[1]
    made = graph.static_shape(node.outputs[0])
    target = None if size is None else graph.array_of(size)
    after = graph.static_shape(source)
    if source is None or made is None or target is None or after is None:
        raise PreconditionError(
            f"{what}: the shape that {node.name} makes is not known"
        )
    before = was[source]
    # Find the same axis in the target shape
    axis = next(at for at, size in enumerate(before) if size != after[at])
    places = [
        at
        for at, length in enumerate(made)
        if length == before[axis] and math.prod(made[:at]) == math.prod(before[:axis])
    ]
    if not places:
        raise PreconditionError(
            f"{what} does not fit {node.name}, which makes {list(made)} of"
            f" {list(before)}: the queries are no axis of that"
        )
    shape = np.array(made, np.int64)
    shape[places[0]] = after[axis]
    name = f"{node.outputs[0].name}_shape"
    node.replace_input_with(1, rewrite.add_constant(where, shape, name))


def _inferred(model: ir.Model, node: ir.Node, what: str) -> dict[str, tuple[int, ...]]:
    cause: Exception | None = None
    try:
        found = infer_node(node, graph.opset_of(model))
    except REFUSALS as error:
        found, cause = {}, error
    if not found:
        read = listed([value for value in node.inputs if value is not None])
        raise PreconditionError(
            f"{what} does not fit {node.name} ({node.op_type}), which reads {read}"
        ) from cause
    # Only static shapes count
    return {
        name: tuple(dim.dim_value for dim in kind.tensor_type.shape.dim)
        for name, kind in found.items()
        if all(dim.HasField("dim_value") for dim in kind.tensor_type.shape.dim)
    }
