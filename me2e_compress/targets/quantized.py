"""Recognise quantized graphs and their pairs of quantization nodes."""

from collections import Counter
from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph.nodes import maker
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
    """Return whether a node stands between a QuantizeLinear and its DequantizeLinears.

    The integers that it reads must have no other reader.
    """
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
