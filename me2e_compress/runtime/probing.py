"""Probes: nodes added to a graph that measure its tensors as they are computed.

A probe follows right after the node that makes its tensor, so that the tensor is freed
as early as without it; all readings are one more output.
"""

from collections.abc import Sequence
from typing import Protocol, TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress.base.errors import GraphError
from me2e_compress.graph import rewrite

READINGS = "me2e_readings"
"""Name of the output that the probes write: float32 [tensors x width of the probe]."""

# Nodes that measure a tensor, in order, and the 1-D values that they produce
Reading: TypeAlias = tuple[list[ir.Node], list[ir.Value]]


class Probe(Protocol):
    """Measures tensors by nodes inserted after them."""

    @property
    def width(self) -> int:
        """Number of values read per tensor."""
        ...

    def read(self, where: ir.Graph, value: ir.Value, at: int) -> Reading:
        """Return the nodes that measure a float32 value, the ``at``-th watched one."""
        ...


def insert_probes(model: ir.Model, tensors: Sequence[str], probe: Probe) -> ir.Model:
    """Return a copy of a graph with a probe after each tensor, and their one output."""
    copy = model.clone()
    made = (value for node in copy.graph for value in node.outputs)
    known = {str(value.name): value for value in (*copy.graph.inputs, *made)}
    if missing := [name for name in tensors if name not in known]:
        raise GraphError(f"the graph has no tensor {missing[0]}")
    # Measure each tensor right after its producer.
    readings = [
        reading
        for at, name in enumerate(tensors)
        for reading in _probe_tensor(copy.graph, known[name], probe, at)
    ]
    # Join all readings into one output.
    joined = ir.node("Concat", readings, {"axis": 0}, name=READINGS)
    joined.outputs[0].name = READINGS
    joined.outputs[0].dtype = ir.DataType.FLOAT
    joined.outputs[0].shape = ir.Shape([len(tensors) * probe.width])
    copy.graph.append(joined)
    copy.graph.outputs.append(joined.outputs[0])
    return copy


def _probe_tensor(
    where: ir.Graph, value: ir.Value, probe: Probe, at: int
) -> Sequence[ir.Value]:
    """Insert the nodes that measure one tensor; return its 1-D readings."""
    nodes: list[ir.Node] = []
    measured = value
    if value.dtype not in (None, ir.DataType.FLOAT):
        nodes.append(ir.node("Cast", [value], {"to": ir.DataType.FLOAT.value}))
        measured = nodes[0].outputs[0]
        measured.shape, measured.dtype = value.shape, ir.DataType.FLOAT
    # Names tell which tensor a probe measures.
    measuring, readings = probe.read(where, measured, at)
    nodes += measuring
    for order, node in enumerate(nodes):
        node.name = f"{READINGS}/{value.name}/{order}_{node.op_type}"
        node.outputs[0].name = node.name
    # A graph input is measured before anything else runs.
    producer = value.producer()
    if producer is not None:
        where.insert_after(producer, nodes)
    elif len(where):
        where.insert_before(where[0], nodes)
    return readings


def shared_constant(
    where: ir.Graph, array: npt.NDArray[np.generic], name: str
) -> ir.Value:
    """Return a constant of the probes, created at its first use."""
    name = f"me2e_probe_{name}"
    known = where.initializers.get(name)
    if known is not None:
        return known
    return rewrite.add_constant(where, array, name, names=set())
