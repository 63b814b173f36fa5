"""Put gauges into a graph: three numbers for every tensor that is watched."""

from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import GraphError

GAUGES = "me2e_gauges"
"""Name of the output that holds them: float32 [3 x tensors]: smallest, largest, sum."""

_REDUCTIONS = ("ReduceMin", "ReduceMax", "ReduceSum")


def tap(model: ir.Model, tensors: Sequence[str]) -> ir.Model:
    """Copy a graph with gauges on some of its tensors.

    Each reduction stands right after the node that makes its tensor, so that an
    executor in priority-based order frees the tensor as early as without gauges. The
    sum is there because onnxruntime's ReduceMin and ReduceMax overlook a NaN unless it
    comes first; a sum never does.

    Args:
        model: the graph; it stays as it is.
        tensors: float tensors to watch, by name.

    Returns:
        The copy; its last output is :data:`GAUGES`.

    Raises:
        GraphError: the graph has no such tensor.
    """
    copy = model.clone()
    known = _values(copy)
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    one = graph.add_constant(copy.graph, np.array([1], np.int64), "me2e_gauge_shape")
    gauges = [
        gauge for name in tensors for gauge in _gauge(copy.graph, known[name], one)
    ]
    joined = ir.node("Concat", gauges, {"axis": 0}, name=GAUGES)
    joined.outputs[0].name = GAUGES
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(gauges)])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def _values(model: ir.Model) -> dict[str, ir.Value]:
    made = (value for node in model.graph for value in node.outputs)
    return {str(value.name): value for value in (*model.graph.inputs, *made)}


def _gauge(where: ir.Graph, value: ir.Value, one: ir.Value) -> list[ir.Value]:
    nodes: list[ir.Node] = []
    ends: list[ir.Value] = []
    for op in _REDUCTIONS:
        reduction = ir.node(op, [value], {"keepdims": 0})
        flat = ir.node("Reshape", [reduction.outputs[0], one])
        nodes += [reduction, flat]
        if value.dtype not in (None, ir.DataType.FLOAT):
            nodes.append(
                ir.node("Cast", [flat.outputs[0]], {"to": ir.DataType.FLOAT.value})
            )
        ends.append(nodes[-1].outputs[0])
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    for order, node in enumerate(nodes):
        node.name = f"{GAUGES}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    return ends
