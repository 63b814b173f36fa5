"""Recognise quantized graphs, and write int8 into graphs: constants and pairs."""

import hashlib
from collections import Counter
from collections.abc import Iterator, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.calibration.observers import scale_of
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import provenance, rewrite, static_shape
from me2e_compress.graph.nodes import Array, maker
from me2e_compress.operators import FusedCall, find, int8_inputs
from me2e_compress.quantization.decision import METADATA, Decision, QuantPlan
from me2e_compress.quantization.plan import share_scales
from me2e_compress.targets.weights import (
    QuantizedWeight,
    bias_by_channel,
    least_scales,
    requantized,
    scales_in,
    weights_of,
    with_room,
)

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


# What multiplies the scale of the symmetric int8 grid, and the zero point
Codes: TypeAlias = tuple[float, np.int8 | np.uint8]
SIGNED: Codes = 1.0, np.int8(0)
POSITIVE: Codes = 127 / 255, np.uint8(0)
"""For tensors without negative numbers: twice the steps."""
SHIFTED: Codes = 1.0, np.uint8(128)
"""The grid of `SIGNED`, as uint8."""


def place_pairs(
    model: ir.Model,
    plan: QuantPlan,
    ranges: Ranges,
    codes: Mapping[str, Codes] | None = None,
) -> ir.Model:
    """Return a copy of a graph in which the plan's nodes read int8.

    Every activation that the plan reads gets a QuantizeLinear and a DequantizeLinear
    (int8, zero point 0, scale = max(|low|, |high|) / 127), or those of its ``codes``.
    Without any, fused operators read integers, as a plugin does.
    """
    weights = weights_of(model, plan.chosen, balanced=plan.balanced)
    copy, shared = model.clone(), share_scales(plan, ranges)
    nodes = {str(node.outputs[0].name): node for node in copy.graph}
    weights = _with_room(weights, nodes, shared)
    pairs = _Pairs(copy.graph, shared, codes)
    for decision in plan.chosen:
        pairs.apply(nodes[decision.output], decision, weights.get(decision.output))
    rewrite.sweep(copy)
    return copy


def _with_room(
    weights: Mapping[str, QuantizedWeight], nodes: Mapping[str, ir.Node], ranges: Ranges
) -> dict[str, QuantizedWeight]:
    """Leave room for the biases: onnxruntime makes int32 of them, others do not."""
    # Layers that share a weight share its scales, so the largest of their least ones
    least: dict[tuple[str, int | None], npt.NDArray[np.float64]] = {}
    for output, weight in weights.items():
        value = nodes[output].inputs[0]
        known = None if value is None else ranges.tensors.get(str(value.name))
        channels = None if weight.axis is None else weight.scales.size
        bias = bias_by_channel(nodes[output], channels)
        if bias is None or known is None:
            continue
        key = weight.name, weight.axis
        wanted = least_scales(bias, scale_of(*known))
        least[key] = np.maximum(wanted, least.get(key, 0.0))
    raised = dict(weights)
    for output, weight in weights.items():
        if (scales := least.get((weight.name, weight.axis))) is not None:
            raised[output] = with_room(weight, scales)
    return raised


class _Pairs:
    """Writes pairs into one graph, once for each tensor and each weight."""

    def __init__(
        self, where: ir.Graph, ranges: Ranges, codes: Mapping[str, Codes] | None
    ) -> None:
        self._write = Writer(where, share=False)
        self._ranges, self._codes = ranges, codes
        self._activations: dict[str, ir.Value] = {}
        self._weights: dict[tuple[str, int | None], ir.Value] = {}
        self._zeros: dict[str, ir.Value] = {}

    def apply(
        self, node: ir.Node, decision: Decision, weight: QuantizedWeight | None
    ) -> None:
        """Rewrite one node to read int8."""
        # A plugin gets integers; layers, and our kernels, get pairs and weights.
        if self._codes is None and (reads := int8_inputs(node)):
            self._connect_integers(node, reads[0])
            return
        for index in decision.activations:
            value = node.inputs[index]
            if value is not None:
                node.replace_input_with(index, self._activation(value, node))
        at = decision.weight
        like = None if at is None else node.inputs[at]
        if weight is not None and at is not None and like is not None:
            node.replace_input_with(at, self._weight(weight, like, node))

    def _connect_integers(self, plugin: ir.Node, index: int) -> None:
        """Let a plugin read integers, with their scale for every channel."""
        value, known = plugin.inputs[index], find(plugin)
        at = None if known is None else known[1].int8_scale
        channels = (static_shape(value) or ())[-1:]
        if value is None or at is None or not channels:
            return
        dequantize = self._activation(value, plugin).producer()
        if dequantize is None:
            return
        # The plugin reads the integers before the DequantizeLinear.
        plugin.replace_input_with(index, dequantize.inputs[0])
        step = scale_of(*self._ranges.tensors[str(value.name)])
        scales = self._write.constant(np.full(channels, step), f"{value.name}_scales")
        plugin.resize_inputs(at + 1)
        plugin.replace_input_with(at, scales)

    def _activation(self, value: ir.Value, reader: ir.Node) -> ir.Value:
        """Return the dequantized tensor that all int8 readers of a value share."""
        name = str(value.name)
        if name not in self._activations:
            exact = np.array(scale_of(*self._ranges.tensors[name]))
            factor, code = (self._codes or {}).get(name, SIGNED)
            step = scales_in(exact * np.float32(factor), _numpy(value))
            scale = self._write.constant(step, f"{name}_scale")
            stored = f"{code.dtype}_{code}" if code else f"{code.dtype}_zero"
            if stored not in self._zeros:
                self._zeros[stored] = self._write.constant(np.array(code), stored)
            names = f"{name}_QuantizeLinear", f"{name}_DequantizeLinear"
            grid = [scale, self._zeros[stored]]
            _, dequantize = self._write.pair(value, grid, names, reader)
            self._activations[name] = dequantize.outputs[0]
        return self._activations[name]

    def _weight(
        self, weight: QuantizedWeight, like: ir.Value, reader: ir.Node
    ) -> ir.Value:
        """Return the dequantized weight that all its readers share."""
        key = weight.name, weight.axis
        if key not in self._weights:
            scales = scales_in(weight.scales, _numpy(like))
            self._weights[key] = self._write.dequantized(
                weight.name,
                requantized(weight.integers, weight.scales, scales, weight.axis),
                scales,
                weight.axis,
                reader,
                f"{weight.name}_DequantizeLinear",
            )
        return self._weights[key]


def _numpy(value: ir.Value) -> np.dtype[np.generic]:
    """Return the type of a tensor's scale: its own, float32 if unknown."""
    return np.dtype(np.float32) if value.dtype is None else value.dtype.numpy()
