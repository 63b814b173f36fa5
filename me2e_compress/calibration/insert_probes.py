"""Put gauges into a graph: a few numbers for every tensor that is watched."""

from collections.abc import Iterator, Sequence

import onnx_ir as ir

from me2e_compress.calibration.probes import Gauge
from me2e_compress.errors import GraphError

GAUGES = "me2e_gauges"
"""Name of the output that holds them: float32 [tensors x width of the gauge]."""


def tap(model: ir.Model, tensors: Sequence[str], gauge: Gauge) -> ir.Model:
    """Copy a graph with a gauge on some of its tensors, each behind its producer.

    Args:
        model: the graph; it stays as it is.
        tensors: float tensors to watch, by name.
        gauge: what is measured of each.

    Returns:
        The copy; its last output is :data:`GAUGES`.

    Raises:
        GraphError: the graph has no such tensor.
    """
    copy = model.clone()
    known = _values(copy)
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    ends = [
        end
        for at, name in enumerate(tensors)
        for end in _watch(copy.graph, known[name], gauge, at)
    ]
    joined = ir.node("Concat", ends, {"axis": 0}, name=GAUGES)
    joined.outputs[0].name = GAUGES
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(tensors) * gauge.width])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def arrange(model: ir.Model) -> None:
    """Let every gauge stand as early as it can, in place.

    onnxruntime runs nodes in the order of the file (``Session(frugal=True)``). Its
    optimizations append what they write to the end: the change back from a blocked
    layout that a gauge reads would come last, and keep the tensors of a whole backbone
    in memory until then.
    """
    nodes = list(model.graph)
    driving = _needed([v for v in model.graph.outputs if v.name != GAUGES])
    waiting = {node: _sources(node) for node in nodes if node not in driving}
    order: list[ir.Node] = []

    def ready(value: ir.Value) -> Iterator[ir.Node]:
        for node in dict.fromkeys(value.consumers()):
            if node in waiting and value in waiting[node]:
                waiting[node].discard(value)
                if not waiting[node]:
                    yield node

    def place(first: Sequence[ir.Node]) -> None:
        pending = list(reversed(first))
        while pending:
            node = pending.pop()
            order.append(node)
            pending += [each for out in node.outputs for each in ready(out)]

    place([node for node in waiting if not waiting[node]])
    for value in model.graph.inputs:
        place(list(ready(value)))
    for node in nodes:
        if node in driving:
            place([node])
    placed = set(order)
    order += [node for node in nodes if node not in placed]
    model.graph.remove(nodes)
    model.graph.extend(order)


def _values(model: ir.Model) -> dict[str, ir.Value]:
    made = (value for node in model.graph for value in node.outputs)
    return {str(value.name): value for value in (*model.graph.inputs, *made)}


def _watch(
    where: ir.Graph, value: ir.Value, gauge: Gauge, at: int
) -> Sequence[ir.Value]:
    nodes: list[ir.Node] = []
    seen = value
    if value.dtype not in (None, ir.DataType.FLOAT):
        nodes.append(ir.node("Cast", [value], {"to": ir.DataType.FLOAT.value}))
        seen = nodes[0].outputs[0]
    measuring, ends = gauge.read(where, seen, at)
    nodes += measuring
    for order, node in enumerate(nodes):
        node.name = f"{GAUGES}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    return ends


def _needed(values: Sequence[ir.Value]) -> set[ir.Node]:
    """Find the nodes that some values are computed by."""
    found: set[ir.Node] = set()
    pending = [node for value in values if (node := value.producer()) is not None]
    while pending:
        node = pending.pop()
        if node not in found:
            found.add(node)
            pending += [p for v in _reads(node) if (p := v.producer()) is not None]
    return found


def _sources(node: ir.Node) -> set[ir.Value]:
    """Give what must be computed before a node can run."""
    return {v for v in _reads(node) if v.producer() is not None or v.is_graph_input()}


def _reads(node: ir.Node) -> Iterator[ir.Value]:
    """Give the inputs of a node and those of the bodies it holds."""
    for value in node.inputs:
        if value is not None:
            yield value
    for attribute in node.attributes.values():
        for body in _bodies(attribute):
            for inner in body.all_nodes():
                for value in inner.inputs:
                    if value is not None and value.graph is node.graph:
                        yield value


def _bodies(attribute: ir.Attr) -> Sequence[ir.Graph]:
    if attribute.type == ir.AttributeType.GRAPH:
        return (attribute.as_graph(),)
    if attribute.type == ir.AttributeType.GRAPHS:
        return tuple(attribute.as_graphs())
    return ()
