"""Write int8 into a graph: constants, nodes, and pairs of quantization nodes."""

import hashlib
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.nodes import Array
from me2e_compress.operators import FusedCall
from me2e_compress.targets.quantized import DEQUANTIZE, QUANTIZE

BY = "quantize-int8"


class Writer:
    """Writes into one graph; with ``share`` equal constants are stored once."""

    def __init__(self, where: ir.Graph, *, share: bool = True) -> None:
        self.graph = where
        self._share = share
        self._constants: dict[tuple[str, bytes], ir.Value] = {}
        self.names = rewrite.value_names(where)

    def constant(self, array: Array, name: str) -> ir.Value:
        """Return the initializer of an array, or add one."""
        if not self._share:
            return rewrite.add_constant(self.graph, array, name, self.names)
        kind = f"{array.dtype}{array.shape}"
        key = (kind, hashlib.sha256(array.tobytes()).digest())
        if key not in self._constants:
            value = rewrite.add_constant(self.graph, array, name, self.names)
            self._constants[key] = value
        return self._constants[key]

    def call(self, before: ir.Node, sources: Sequence[ir.Node]) -> FusedCall:
        """Return what inserts nodes in front of one; they stand for the sources."""
        call = _SharingCall(self, before)
        call.sources = tuple(sources)
        return call

    def node(
        self,
        op: str,
        inputs: Sequence[ir.Value],
        name: str,
        sources: Sequence[ir.Node],
        attributes: dict[str, int] | None = None,
    ) -> ir.Node:
        """Build a node with a unique name and the sources' provenance."""
        unique = rewrite.fresh_name(name, self.names)
        node = ir.node(op, inputs, attributes or {}, name=unique)
        node.outputs[0].name = unique
        provenance.inherit(node, sources, by=BY)
        return node

    def pair(
        self,
        value: ir.Value,
        grid: Sequence[ir.Value],
        names: tuple[str, str],
        source: ir.Node,
    ) -> tuple[ir.Node, ir.Node]:
        """Insert QuantizeLinear and DequantizeLinear behind the producer of a value.

        ``grid`` is scale and zero point, ``source`` gives the provenance.
        """
        scale, zero = grid
        quantize = self.node(QUANTIZE, [value, *grid], names[0], [source])
        integers = quantize.outputs[0]
        dequantize = self.node(DEQUANTIZE, [integers, *grid], names[1], [source])
        # Both have the shape of the value
        integers.type = zero.type
        dequantize.outputs[0].type = scale.type
        integers.shape = dequantize.outputs[0].shape = value.shape
        producer = value.producer()
        if producer is None:
            self.graph.insert_before(self.graph[0], [quantize, dequantize])
        else:
            self.graph.insert_after(producer, [quantize, dequantize])
        return quantize, dequantize

    def dequantized(
        self,
        name: str,
        integers: Array,
        scales: Array,
        axis: int | None,
        reader: ir.Node,
        label: str = "",
    ) -> ir.Value:
        """Store integers and insert their DequantizeLinear before the reader.

        ``scales`` is [channels] along ``axis`` of the integers, or a scalar with
        ``axis`` None; ``label`` names the node, empty for a name after its reader.
        Returns the dequantized tensor, of the scales' type.
        """
        zeros = np.zeros(scales.shape, integers.dtype)
        stored = self.constant(integers, f"{name}_{integers.dtype}")
        steps = self.constant(scales, f"{name}_scale")
        # Not shared: with ``session.x64quantprecision``, which processors without VNNI
        # need, onnxruntime (1.31) refuses a zero point that two weights read
        zero = rewrite.add_constant(self.graph, zeros, f"{name}_zero", self.names)
        inputs = [stored, steps, zero]
        axes = None if axis is None else {"axis": axis}
        # Weights may be shared, the name of the reader is not
        label = label or f"{reader.name or reader.outputs[0].name}/{name}_float"
        node = self.node(DEQUANTIZE, inputs, label, [reader], axes)
        node.outputs[0].shape = ir.Shape(integers.shape)
        node.outputs[0].type = steps.type
        self.graph.insert_before(reader, node)
        return node.outputs[0]


class _SharingCall(FusedCall):
    """Inserts nodes whose constants are the writer's, one for all of the same sizes."""

    def __init__(self, writer: Writer, node: ir.Node) -> None:
        opset = graph.opset_of(writer.graph)
        super().__init__(node, opset=opset, by=BY, names=writer.names)
        self._writer = writer

    def constant(self, array: Array, name: str = "constant") -> ir.Value:
        """Return the initializer of an array."""
        return self._writer.constant(array, name)
