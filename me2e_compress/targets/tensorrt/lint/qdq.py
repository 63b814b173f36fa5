"""Explicit quantization: TensorRT's requirements on pairs and their positions.

Sources: NvInfer.h and the ONNX parser of TensorRT 10.7; its developer guide, "Explicit
quantization". What TensorRT-RTX's parser accepts silently (scales by channel on
activations, uint8) is an error here.
"""

from collections.abc import Iterator

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import CONVOLUTIONS, WEIGHTED, array_of, is_standard
from me2e_compress.graph.shapes import extent
from me2e_compress.operators import find, int8_inputs
from me2e_compress.targets import LintFinding, LintRule, rule_of_nodes, warning
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    PAIR,
    QUANTIZE,
    is_dequantized,
    is_quantized,
    pairs_of,
    stored_type,
)

# Quantized types of TensorRT 10 ("Working with Quantized Types"): int4 is for weights
# alone, with scales by block
_ACTIVATIONS = (ir.DataType.INT8, ir.DataType.FLOAT8E4M3FN)
_WEIGHTS = (*_ACTIVATIONS, ir.DataType.INT4)


# Each node of a pair: its type, scale and zero point


@rule_of_nodes("scale", "error", pairs_of)
def scales(node: ir.Node) -> Iterator[str]:
    """Check that scales are constants, finite and above 0."""
    scale = array_of(node.inputs[1])
    if scale is None:
        yield "the scale is computed, must be a constant"
        return
    numbers = scale.astype(np.float64)
    if not (np.isfinite(numbers).all() and (numbers > 0).all()):
        yield f"scale {float(numbers.min()):g}, must be finite and above 0"


@rule_of_nodes("quantized-type", "error", pairs_of)
def quantized_types(node: ir.Node) -> Iterator[str]:
    """Check that the stored type is one that TensorRT has."""
    kind = stored_type(node)
    if kind not in (_WEIGHTS if _is_weight(node) else _ACTIVATIONS):
        weights = ": int4 is for weights" if kind == ir.DataType.INT4 else ""
        yield f"{kind.name.lower()}, must be int8 or float8e4m3fn{weights}"


@rule_of_nodes("zero-point", "error", pairs_of)
def zero_points(node: ir.Node) -> Iterator[str]:
    """Check that quantization is symmetric: zero points are 0."""
    value = graph.input_at(node, 2)
    zero = array_of(value)
    if value is not None and zero is None:
        yield "the zero point is computed"
    elif zero is not None and zero.astype(np.float32).any():
        point = float(zero.reshape(-1)[np.flatnonzero(zero)[0]])
        yield f"zero point {point:g}, must be 0"


@rule_of_nodes("scalar-pair", "error", pairs_of)
def scalars(node: ir.Node) -> Iterator[str]:
    """Check that quantized tensors have at least one dimension."""
    if graph.static_shape(node.inputs[0]) == ():
        yield f"{node.op_type} of a 0-D tensor"


@rule_of_nodes("channel-scale", "error", pairs_of)
def channel_scales(node: ir.Node) -> Iterator[str]:
    """Check that activations have one scale, and weights one or one per channel."""
    scale = graph.static_shape(node.inputs[1])
    if not scale or scale == (1,):
        return
    if len(scale) > 1:
        if not _is_by_block(node):
            yield f"scales of shape {list(scale)}: by block"
    elif not _is_weight(node):
        yield "an activation has one scale a channel"


@rule_of_nodes("weight-axis", "error", pairs_of)
def weight_axes(node: ir.Node) -> Iterator[str]:
    """Check that scales of a weight run along the axis of its output channels."""
    scale = graph.static_shape(node.inputs[1])
    if scale is None or len(scale) != 1 or scale == (1,) or not _is_weight(node):
        return
    if "axis" not in node.attributes:
        yield "no axis: ONNX takes 1, TensorRT takes 0"
        return
    # The scales of a DequantizeLinear must fit the weight
    shape, axis = graph.static_shape(node.inputs[0]), node.attributes.get_int("axis", 1)
    if node.op_type != DEQUANTIZE or shape is None:
        return
    axis += len(shape) if axis < 0 else 0
    if axis >= len(shape) or shape[axis] != scale[0]:
        yield f"{scale[0]} scales along axis {axis} of {list(shape)}"
        return
    # The axis must be that of each reader's channels
    for reader in node.outputs[0].consumers():
        if reader.op_type in WEIGHTED and reader.inputs[1] is node.outputs[0]:
            wanted = graph.channel_axis(reader)
            if axis != wanted:
                yield (
                    f"scales along axis {axis}; output channels of {reader.op_type}"
                    f" run along {wanted}"
                )


# Where pairs stand


@rule_of_nodes("bias-pair", "error")
def biases(node: ir.Node) -> Iterator[str]:
    """Check that biases are float: no pair, no int32 before a DequantizeLinear."""
    biased = node.op_type in (*CONVOLUTIONS, "Gemm")
    if biased and is_dequantized(graph.bias_of(node)):
        yield "the bias is quantized, must be float"


@rule_of_nodes("unpaired", "error", pairs_of)
def completeness(node: ir.Node) -> Iterator[str]:
    """Check that only DequantizeLinears of the same scale read a QuantizeLinear."""
    # A plugin that takes int8, and its scale as another input, may also read it
    source, result = node.inputs[0], node.outputs[0]
    if node.op_type != QUANTIZE:
        if array_of(source) is None and not is_quantized(source):
            producer = graph.producer_of(source)
            what = "a graph input" if producer is None else producer.op_type
            yield f"reads integers of {what}"
        return
    if result.is_graph_output():
        yield "its integers are a graph output"
    readers = list(result.consumers())
    for reader in readers:
        # A plugin may take int8 features, and have their scale
        plugin = find(reader) if int8_inputs(reader) else None
        at = None if plugin is None else plugin[1].int8_scale
        if at is not None and graph.input_at(reader, at) is not None:
            continue
        if reader.op_type != DEQUANTIZE or not is_standard(reader):
            yield f"its integers are read by {reader.op_type}"
            continue
        left, right = (array_of(pair.inputs[1]) for pair in (node, reader))
        if left is not None and right is not None and not np.array_equal(left, right):
            yield "quantized and dequantized on two scales"
    if not readers and not result.is_graph_output():
        yield "nothing reads its integers"


@rule_of_nodes("integer-pair", "error")
def integers(node: ir.Node) -> Iterator[str]:
    """Check that indices and shapes are not computed from dequantized numbers."""
    whole = (ir.DataType.INT32.value, ir.DataType.INT64.value)
    is_cast = node.op_type == "Cast" and node.attributes.get_int("to", 0) in whole
    if is_cast and is_dequantized(node.inputs[0]):
        yield "a dequantized tensor is cast to an index or shape"


@rule_of_nodes("repeated-pair", "warning", pairs_of)
def repeated_pairs(node: ir.Node) -> Iterator[str]:
    """Find tensors that are quantized twice in a row."""
    if node.op_type == QUANTIZE and is_dequantized(node.inputs[0]):
        yield "quantizes what was just dequantized"


def outputs(model: ir.Model) -> Iterator[LintFinding]:
    """Find outputs of the graph that are rounded to int8."""
    for value in model.graph.outputs:
        if is_dequantized(value):
            message = f"graph output {value.name} is rounded"
            yield warning("output-pair", value.producer(), message)


@rule_of_nodes("residual-branch", "warning")
def branches(node: ir.Node) -> Iterator[str]:
    """Find pairs between a convolution and its Add: only the residual may have one."""
    if node.op_type != "Add" or not is_standard(node):
        return
    if any(map(_is_convolution, node.inputs)):
        return
    for value in node.inputs:
        # A pair of a convolution that nothing else reads
        if value is None or not is_dequantized(value) or len(value.uses()) != 1:
            continue
        dequantize = value.producer()
        assert dequantize is not None
        quantize = graph.producer_of(dequantize.inputs[0])
        source = None if quantize is None else quantize.inputs[0]
        if _is_convolution(source) and source is not None and len(source.uses()) == 1:
            yield "a pair between a convolution and its Add keeps the two from fusing"
            return


@rule_of_nodes("half-quantized", "warning")
def half_quantized(node: ir.Node) -> Iterator[str]:
    """Find layers with only one int8 operand."""
    # A matrix-vector product may have a float activation: its weight decides its speed
    if node.op_type not in WEIGHTED or not is_standard(node):
        return
    # Tell which operand is float: the remedy differs
    sides = [is_dequantized(value) for value in node.inputs[:2]]
    if sides == [True, False]:
        yield "its weight is float: it runs in float"
    if sides != [False, True]:
        return
    if not _is_constant(node.inputs[1]):
        yield "only one operand is int8"
        return
    # int4 is for the weight alone, and pays where reading that takes the time
    pair = graph.producer_of(node.inputs[1])
    product = node.op_type in ("Gemm", "MatMul")
    is_vector = product and extent(node, weight=True).is_vector
    if not is_vector and (pair is None or not _is_by_block(pair)):
        yield "its activation is float: it runs in float"


@rule_of_nodes("float-weight", "warning", pairs_of)
def float_weights(node: ir.Node) -> Iterator[str]:
    """Find weights stored as float and quantized when the engine is built."""
    if node.op_type == QUANTIZE and array_of(node.inputs[0]) is not None:
        yield "the weight is stored as float"


def _is_weight(node: ir.Node) -> bool:
    """Return whether a pair quantizes a constant."""
    value = node.inputs[0]
    return array_of(value) is not None or (is_quantized(value) and _is_constant(value))


def _is_by_block(node: ir.Node) -> bool:
    """Return whether a pair is that of an int4 weight, whose scales are by block."""
    blocks = node.attributes.get_int("block_size", 0)
    return stored_type(node) == ir.DataType.INT4 and blocks > 0 and _is_weight(node)


def _is_constant(value: ir.Value | None) -> bool:
    """Return whether a value is a constant, possibly through pairs."""
    node = graph.producer_of(value)
    if node is not None and node.op_type in PAIR:
        return _is_constant(node.inputs[0])
    return array_of(value) is not None


def _is_convolution(value: ir.Value | None) -> bool:
    node = graph.producer_of(value)
    return node is not None and node.op_type in CONVOLUTIONS


RULES: tuple[LintRule, ...] = (
    scales,
    quantized_types,
    zero_points,
    biases,
    scalars,
    completeness,
    integers,
    channel_scales,
    weight_axes,
    repeated_pairs,
    outputs,
    branches,
    half_quantized,
    float_weights,
)
