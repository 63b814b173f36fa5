"""Which tensors become uint8, and who reads them so."""

import dataclasses
from collections.abc import Collection

import onnx_ir as ir

from me2e_compress.targets.onnxruntime.kernels import (
    JOINS,
    end_of,
    is_layer,
    is_move,
)


@dataclasses.dataclass(frozen=True)
class Region:
    """The int8 part of a graph.

    Attributes:
        layers: convolutions and matrix products in graph order, and what they read.
        grids: the uint8 tensors, and whose range each of them takes: mostly its own,
            that of the first tensor where elements are only moved.
        born: those that an int8 kernel answers, so that no float one exists.
        readers: what reads uint8 besides the layers.
    """

    layers: dict[ir.Node, ir.Value]
    grids: dict[ir.Value, ir.Value]
    born: frozenset[ir.Value]
    readers: frozenset[ir.Node]

    @property
    def ranged(self) -> tuple[str, ...]:
        """Name the tensors whose range must be known."""
        return tuple(dict.fromkeys(str(each.name) for each in self.grids.values()))

    def reads(self, node: ir.Node, index: int) -> bool:
        """Say whether a node takes an input as uint8, wherever that exists."""
        if node in self.readers:
            return index == 0 or node.op_type in JOINS
        return node in self.layers and index == 0


def find_region(graph: ir.Graph, chosen: Collection[str]) -> Region:
    """Grow the int8 part of a graph from its layers, in one walk.

    * A layer reads uint8. A convolution also answers it, since QLinearConv knows
      nothing else; a matrix product may answer float (QGemm does).
    * What only moves elements (pooling, nearest Resize, layout) stays in uint8.
    * An Add or Concat of uint8 tensors stays if a convolution gave one of them and a
      layer reads the result: the residual branches and merges of a backbone or neck.
      The sums around a LayerNorm join two float tensors and stay float.

    Args:
        graph: read as float everywhere, in topological order.
        chosen: the layers that are to be int8, by the name of their first output;
            those without a kernel are left out.
    """
    layers = {
        node: node.inputs[0]
        for node in graph
        if node.outputs[0].name in chosen
        and node.inputs[0] is not None
        and is_layer(node)
    }
    grids = {value: value for value in layers.values()}
    born: set[ir.Value] = set()
    readers: set[ir.Node] = set()
    convolutions = {layer for layer in layers if layer.op_type == "Conv"}
    for node in graph:
        first = node.inputs[0] if node.inputs else None
        end = end_of(node)
        if node in convolutions:
            grids[end] = end
            born.add(end)
        elif first is not None and first in born and is_move(node):
            grids[node.outputs[0]] = grids[first]
            born.add(node.outputs[0])
            readers.add(node)
        elif node.op_type in JOINS and end in grids and _joins(node, grids, born):
            born.add(end)
            readers.add(node)
    return Region(layers, grids, frozenset(born), frozenset(readers))


def _joins(
    node: ir.Node, grids: Collection[ir.Value], born: Collection[ir.Value]
) -> bool:
    return all(each in grids for each in node.inputs) and any(
        each in born for each in node.inputs
    )
