"""What a graph takes, gives and weighs: ports, nodes, bytes."""

import dataclasses
from collections.abc import Iterable

import onnx_ir as ir

from me2e_compress.graph.macs import macs_counter, total_macs
from me2e_compress.graph.nodes import nodes_in


@dataclasses.dataclass(frozen=True)
class Port:
    """One input or output: name, ONNX type and shape as text, e.g. ``[1, 6, 'W']``."""

    name: str
    type: str
    shape: str


def interface(model: ir.Model) -> tuple[tuple[Port, ...], tuple[Port, ...]]:
    """List the inputs and the outputs: no pass may change these unasked."""
    return _ports(model.graph.inputs), _ports(model.graph.outputs)


@dataclasses.dataclass(frozen=True)
class Size:
    """Nodes, weights and cost of a graph.

    Attributes:
        nodes: nodes, those in subgraphs and in every call of a function included.
        weight_bytes: bytes of all initializers.
        macs: multiply-accumulates of the nodes whose count is known: where others are
            unknown, a lower bound, and None instead of 0.
        unknown_macs_nodes: how many nodes are not in ``macs``: plugins, and operators
            of unknown shape.
    """

    nodes: int
    weight_bytes: int
    macs: int | None
    unknown_macs_nodes: int


def size(model: ir.Model) -> Size:
    """Measure a graph."""
    found, unknown = total_macs(map(macs_counter(model), nodes_in(model.graph)))
    return Size(
        nodes=node_count(model),
        weight_bytes=sum(
            value.const_value.nbytes
            for graph in model.graphs()
            for value in graph.initializers.values()
            if value.const_value is not None
        ),
        macs=found,
        unknown_macs_nodes=unknown,
    )


def node_count(model: ir.Model) -> int:
    """Count nodes as a runtime sees them: a function counts at every call."""
    bodies: dict[ir.OperatorIdentifier, int] = {}

    def count(node: ir.Node) -> int:
        key = node.op_identifier()
        function = model.functions.get(key)
        if function is None:
            return 1
        if key not in bodies:
            bodies[key] = sum(count(inner) for inner in nodes_in(function))
        return bodies[key]

    return sum(count(node) for node in nodes_in(model.graph))


def _ports(values: Iterable[ir.Value]) -> tuple[Port, ...]:
    return tuple(Port(v.name or "", str(v.type), str(v.shape)) for v in values)
