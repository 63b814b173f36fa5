"""Explicit quantization: TensorRT's requirements on pairs and their positions.

Sources: NvInfer.h and the ONNX parser of TensorRT 10.7; its developer guide, "Explicit
quantization". What TensorRT-RTX's parser accepts silently (scales by channel on
activations, uint8) is an error here.
"""

from collections.abc import Iterator

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import CONVOLUTIONS, WEIGHTED, is_standard, nodes_of
from me2e_compress.graph.shapes import extent
from me2e_compress.operators import find, int8_inputs
from me2e_compress.targets.base import LintFinding, error, warning
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    PAIR,
    QUANTIZE,
    is_dequantized,
    is_quantized,
    pairs_of,
)


def stored(value: ir.Value | None) -> bool:
    """Return whether a value is an initializer or a Constant."""
    return graph.array_of(value) is not None


def scales(model: ir.Model) -> Iterator[LintFinding]:
    """Check that scales are constants, finite and above 0."""
    for node in pairs_of(model):
        scale = graph.array_of(node.inputs[1])
        if scale is None:
            yield error("scale", node, "the scale is computed, must be a constant")
            continue
        numbers = scale.astype(np.float64)
        if not np.isfinite(numbers).all() or not (numbers > 0).all():
            worst = float(numbers.min())
            yield error("scale", node, f"scale {worst:g}, must be finite and above 0")


def zero_points(model: ir.Model) -> Iterator[LintFinding]:
    """Check that quantization is symmetric: zero points are 0, of type int8."""
    for node in pairs_of(model):
        value = graph.input_at(node, 2)
        kind = _integer_type(node, value)
        if kind != ir.DataType.INT8:
            name = "uint8" if kind is None else kind.name.lower()
            yield error("quantized-type", node, f"{name}, must be int8")
        zero = graph.array_of(value)
        if value is not None and zero is None:
            yield error("zero-point", node, "the zero point is computed")
        elif zero is not None and zero.any():
            found = int(zero.reshape(-1)[np.flatnonzero(zero)[0]])
            yield error("zero-point", node, f"zero point {found}, must be 0")


def biases(model: ir.Model) -> Iterator[LintFinding]:
    """Check that biases are float: no pair, no int32 before a DequantizeLinear."""
    for node in nodes_of(model):
        if node.op_type not in (*graph.CONVOLUTIONS, "Gemm"):
            continue
        if is_dequantized(graph.bias_of(node)):
            yield error("bias-pair", node, "the bias is quantized, must be float")


def scalars(model: ir.Model) -> Iterator[LintFinding]:
    """Check that quantized tensors have at least one dimension."""
    for node in pairs_of(model):
        if graph.static_shape(node.inputs[0]) == ():
            yield error("scalar-pair", node, f"{node.op_type} of a 0-D tensor")


def completeness(model: ir.Model) -> Iterator[LintFinding]:
    """Check that only DequantizeLinears of the same scale read a QuantizeLinear.

    A plugin that takes int8, and its scale as another input, may also read it.
    """
    for node in pairs_of(model):
        if node.op_type == QUANTIZE:
            yield from _readers(node)
        elif not stored(node.inputs[0]) and not is_quantized(node.inputs[0]):
            made = graph.producer_of(node.inputs[0])
            what = "a graph input" if made is None else made.op_type
            yield error("unpaired", node, f"reads integers of {what}")


def _readers(node: ir.Node) -> Iterator[LintFinding]:
    result = node.outputs[0]
    if result.is_graph_output():
        yield error("unpaired", node, "its integers are a graph output")
    readers = list(result.consumers())
    for reader in readers:
        if _takes_integers(reader):
            continue
        if reader.op_type != DEQUANTIZE or not is_standard(reader):
            yield error("unpaired", node, f"its integers are read by {reader.op_type}")
        elif not _same_scale(node, reader):
            yield error("unpaired", node, "quantized and dequantized on two scales")
    if not readers and not result.is_graph_output():
        yield error("unpaired", node, "nothing reads its integers")


def _takes_integers(plugin: ir.Node) -> bool:
    """Return whether a plugin takes int8 features and has their scale."""
    found = find(plugin) if int8_inputs(plugin) else None
    at = None if found is None else found[1].int8_scale
    return at is not None and graph.input_at(plugin, at) is not None


def integers(model: ir.Model) -> Iterator[LintFinding]:
    """Check that indices and shapes are not computed from dequantized numbers."""
    whole = {ir.DataType.INT32.value, ir.DataType.INT64.value}
    for node in nodes_of(model):
        if node.op_type != "Cast" or not is_dequantized(node.inputs[0]):
            continue
        if node.attributes.get_int("to", 0) in whole:
            yield error(
                "integer-pair",
                node,
                "a dequantized tensor is cast to an index or shape",
            )


def _same_scale(one: ir.Node, other: ir.Node) -> bool:
    left, right = graph.array_of(one.inputs[1]), graph.array_of(other.inputs[1])
    return left is None or right is None or np.array_equal(left, right)


def _integer_type(node: ir.Node, zero: ir.Value | None) -> ir.DataType | None:
    """Return the integer type: the zero point's, else the tensor's, else uint8."""
    if node.op_type == DEQUANTIZE and node.inputs[0] is not None:
        kind = node.inputs[0].dtype
        if kind is not None:
            return kind
    if zero is not None and zero.dtype is not None:
        return zero.dtype
    return ir.DataType.UINT8 if zero is None else None


def channel_scales(model: ir.Model) -> Iterator[LintFinding]:
    """Check that activations have one scale, and weights one or one per channel."""
    for node in pairs_of(model):
        scale = graph.static_shape(node.inputs[1])
        # One scale is always allowed.
        if not scale or scale == (1,):
            continue
        if len(scale) > 1:
            yield error(
                "channel-scale", node, f"scales of shape {list(scale)}: by block"
            )
        elif not _is_weight(node):
            yield error("channel-scale", node, "an activation has one scale a channel")
        elif "axis" not in node.attributes:
            yield error("weight-axis", node, "no axis: ONNX takes 1, TensorRT takes 0")
        elif node.op_type == DEQUANTIZE:
            yield from _axis(node)


def _axis(node: ir.Node) -> Iterator[LintFinding]:
    shape, scale = (
        graph.static_shape(node.inputs[0]),
        graph.static_shape(node.inputs[1]),
    )
    axis = node.attributes.get_int("axis", 1)
    if shape is None or scale is None:
        return
    # Scales must match the axis, and that the output channels.
    axis += len(shape) if axis < 0 else 0
    if axis >= len(shape) or shape[axis] != scale[0]:
        yield error(
            "weight-axis", node, f"{scale[0]} scales along axis {axis} of {list(shape)}"
        )
        return
    # The axis must be that of each reader's channels.
    for reader in node.outputs[0].consumers():
        if reader.op_type in WEIGHTED and reader.inputs[1] is node.outputs[0]:
            wanted = graph.channel_axis(reader)
            if axis != wanted:
                yield error(
                    "weight-axis",
                    node,
                    f"scales along axis {axis}; output channels of {reader.op_type}"
                    f" run along {wanted}",
                )


def repeated_pairs(model: ir.Model) -> Iterator[LintFinding]:
    """Find tensors that are quantized twice in a row."""
    for node in pairs_of(model):
        if node.op_type == QUANTIZE and is_dequantized(node.inputs[0]):
            yield warning("repeated-pair", node, "quantizes what was just dequantized")


def outputs(model: ir.Model) -> Iterator[LintFinding]:
    """Find outputs of the graph that are rounded to int8."""
    for value in model.graph.outputs:
        if is_dequantized(value):
            yield warning(
                "output-pair", value.producer(), f"graph output {value.name} is rounded"
            )


def branches(model: ir.Model) -> Iterator[LintFinding]:
    """Find pairs between a convolution and its Add: only the residual may have one."""
    for node in nodes_of(model):
        if node.op_type != "Add" or not is_standard(node):
            continue
        # One operand may be quantized: the residual.
        rounded = [_rounds_convolution(value) for value in node.inputs]
        if any(rounded) and not any(_is_convolution(value) for value in node.inputs):
            yield warning(
                "residual-branch",
                node,
                "a pair between a convolution and its Add keeps the two from fusing",
            )


def half_quantized(model: ir.Model) -> Iterator[LintFinding]:
    """Find layers with only one int8 operand.

    A matrix-vector product may have a float activation: its weight decides its speed.
    """
    for node in nodes_of(model):
        if node.op_type not in WEIGHTED or not is_standard(node):
            continue
        # Tell which operand is float: the remedy differs.
        sides = [is_dequantized(value) for value in node.inputs[:2]]
        if sides == [True, False]:
            yield warning(
                "half-quantized", node, "its weight is float: it runs in float"
            )
        elif sides == [False, True] and not _only_stored(node.inputs[1]):
            yield warning("half-quantized", node, "only one operand is int8")
        elif sides == [False, True] and not _is_vector(node):
            yield warning(
                "half-quantized", node, "its activation is float: it runs in float"
            )


def float_weights(model: ir.Model) -> Iterator[LintFinding]:
    """Find weights stored as float and quantized when the engine is built."""
    for node in pairs_of(model):
        value = node.inputs[0]
        if node.op_type == QUANTIZE and stored(value):
            yield warning("float-weight", node, "the weight is stored as float")


def _is_vector(node: ir.Node) -> bool:
    """Return whether a layer is a matrix-vector product."""
    products = ("Gemm", "MatMul")
    return node.op_type in products and extent(node, weight=True).is_vector


def _is_weight(node: ir.Node) -> bool:
    """Return whether a pair quantizes a constant."""
    value = node.inputs[0]
    return stored(value) or (is_quantized(value) and _only_stored(value))


def _only_stored(value: ir.Value | None) -> bool:
    """Return whether a value is a constant, possibly through pairs."""
    node = graph.producer_of(value)
    if node is not None and node.op_type in PAIR:
        return _only_stored(node.inputs[0])
    return stored(value)


def _rounds_convolution(value: ir.Value | None) -> bool:
    """Return whether a value is a pair of a convolution without other readers."""
    if value is None or not is_dequantized(value) or len(value.uses()) != 1:
        return False
    node = value.producer()
    quantize = None if node is None else graph.producer_of(node.inputs[0])
    source = quantize.inputs[0] if quantize is not None else None
    return _is_convolution(source) and source is not None and len(source.uses()) == 1


def _is_convolution(value: ir.Value | None) -> bool:
    node = graph.producer_of(value)
    return node is not None and node.op_type in CONVOLUTIONS
