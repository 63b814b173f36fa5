"""Recognise quantized graphs, and write int8 into graphs: constants and pairs."""

import hashlib
from collections import Counter
from collections.abc import Iterator, Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import provenance, rewrite
from me2e_compress.graph.nodes import Array, maker
from me2e_compress.operators import FusedCall
from me2e_compress.quantization.decision import METADATA

QUANTIZE, DEQUANTIZE = PAIR = ("QuantizeLinear", "DequantizeLinear")
# Operators on integers (ONNX, com.microsoft) that quantizers of runtimes write
INTEGER_OPS = frozenset(
    {
        "ConvInteger", "DynamicQuantizeLinear", "DynamicQuantizeLSTM",
        "DynamicQuantizeMatMul", "MatMulBnb4", "MatMulInteger", "MatMulIntegerToFloat",
        "MatMulNBits", "QAttention", "QEmbedLayerNormalization", "QGemm",
        "QLinearAdd", "QLinearAveragePool", "QLinearConcat", "QLinearConv",
        "QLinearGlobalAveragePool", "QLinearLeakyRelu", "QLinearMatMul", "QLinearMul",
        "QLinearSigmoid", "QLinearSoftmax", "QLinearWhere",
    }
)  # fmt: skip


def pairs_of(model: ir.Model) -> Iterator[ir.Node]:
    """Yield the QuantizeLinear and DequantizeLinear nodes, also in functions."""
    for node in graph.nodes_of(model):
        if graph.is_standard(node) and node.op_type in PAIR:
            yield node


def is_quantized(value: ir.Value | None) -> bool:
    """Return whether a value is the output of a QuantizeLinear."""
    return maker(value, QUANTIZE) is not None


def is_dequantized(value: ir.Value | None) -> bool:
    """Return whether a value is the output of a DequantizeLinear."""
    return maker(value, DEQUANTIZE) is not None


def is_in_a_pair(node: ir.Node) -> bool:
    """Return whether a node stands between the two nodes of a pair."""
    # The integers that it reads must have no other reader
    before, after = node.inputs[0], node.outputs[0]
    if before is None or not is_quantized(before) or after.is_graph_output():
        return False
    readers = {reader.op_type for reader in after.consumers()}
    return readers == {DEQUANTIZE} and len(before.uses()) == 1


def stored_type(node: ir.Node) -> ir.DataType:
    """Return the type of the numbers that a node of a pair writes or reads.

    That of its zero point or, without one, of the tensor that is read; else what
    ``output_dtype`` of the quantizer says: uint8 by default.
    """
    source = node if node.op_type == QUANTIZE else maker(node.inputs[0], QUANTIZE)
    typed = graph.input_at(source or node, 2)
    if typed is None and source is None:
        typed = node.inputs[0]
    if typed is not None and typed.dtype is not None:
        return typed.dtype
    number = 0 if source is None else source.attributes.get_int("output_dtype", 0)
    return ir.DataType(number or ir.DataType.UINT8)


def describe_quantized(model: ir.Model) -> str | None:
    """Describe operators, grid and producer of a quantized graph; None for others."""
    nodes = list(model.graph.all_nodes())
    counts = Counter(n.op_type for n in nodes if n.op_type in {*INTEGER_OPS, *PAIR})
    if not counts:
        return None
    # Operators first, then the grid and the producer
    parts = [", ".join(f"{count} {op}" for op, count in sorted(counts.items()))]
    if pairs := [node for node in nodes if node.op_type in PAIR]:
        # The element types of all pairs, and whether they are symmetric
        types = dict.fromkeys(stored_type(node).name.lower() for node in pairs)
        zeros = [graph.array_of(graph.input_at(node, 2)) for node in pairs]
        centred = not any(zero.any() for zero in zeros if zero is not None)
        grid = "zero points 0" if centred else "zero points that are not 0"
        parts.append(f"{' and '.join(types)} with {grid}")
    if METADATA in model.metadata_props:
        parts.append("it carries the plan it was made by")
    elif model.producer_name:
        parts.append(f"made by {model.producer_name}")
    return "; ".join(parts)


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
