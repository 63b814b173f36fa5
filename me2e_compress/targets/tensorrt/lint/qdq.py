"""Explicit quantization: TensorRT's requirements on pairs and their positions.

Sources: NvInfer.h and the ONNX parser of TensorRT 10.7; its developer guide, "Explicit
quantization". What TensorRT-RTX's parser accepts silently (scales by channel on
activations, uint8) is an error here.
"""

from collections.abc import Callable, Iterable, Iterator
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import CONVOLUTIONS, WEIGHTED, is_standard, nodes_of
from me2e_compress.graph.shapes import extent
from me2e_compress.operators import find, int8_inputs
from me2e_compress.targets import LintFinding, LintRule, error, warning
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    PAIR,
    QUANTIZE,
    is_dequantized,
    is_quantized,
    pairs_of,
    stored_type,
)

# Says what is wrong about one node; None if nothing is
Check: TypeAlias = Callable[[ir.Node], str | None]


def _rule(
    rule: str,
    finding: Callable[[str, ir.Node | None, str], LintFinding],
    nodes: Callable[[ir.Model], Iterable[ir.Node]] = pairs_of,
) -> Callable[[Check], LintRule]:
    """Make a rule of a check of one node: by default of every node of a pair."""

    def of(check: Check) -> LintRule:
        def lint(model: ir.Model) -> Iterator[LintFinding]:
            for node in nodes(model):
                if message := check(node):
                    yield finding(rule, node, message)

        return lint

    return of


def stored(value: ir.Value | None) -> bool:
    """Return whether a value is an initializer or a Constant."""
    return graph.array_of(value) is not None


@_rule("scale", error)
def scales(node: ir.Node) -> str | None:
    """Check that scales are constants, finite and above 0."""
    scale = graph.array_of(node.inputs[1])
    if scale is None:
        return "the scale is computed, must be a constant"
    numbers = scale.astype(np.float64)
    if np.isfinite(numbers).all() and (numbers > 0).all():
        return None
    return f"scale {float(numbers.min()):g}, must be finite and above 0"


_ACTIVATIONS = (ir.DataType.INT8, ir.DataType.FLOAT8E4M3FN)
# Quantized types of TensorRT 10 ("Working with Quantized Types"): int4 is for weights
# alone, with scales by block
_WEIGHTS = (*_ACTIVATIONS, ir.DataType.INT4)


def zero_points(model: ir.Model) -> Iterator[LintFinding]:
    """Check that quantization is symmetric: zero points are 0, of a type it takes."""
    for node in pairs_of(model):
        value, kind = graph.input_at(node, 2), stored_type(node)
        if kind not in (_WEIGHTS if _is_weight(node) else _ACTIVATIONS):
            wanted = "int8 or float8e4m3fn"
            if kind == ir.DataType.INT4:
                wanted += ": int4 is for weights"
            name = kind.name.lower()
            yield error("quantized-type", node, f"{name}, must be {wanted}")
        zero = graph.array_of(value)
        if value is not None and zero is None:
            yield error("zero-point", node, "the zero point is computed")
        elif zero is not None and zero.astype(np.float32).any():
            point = float(zero.reshape(-1)[np.flatnonzero(zero)[0]])
            yield error("zero-point", node, f"zero point {point:g}, must be 0")


def _is_weight(node: ir.Node) -> bool:
    """Return whether a pair quantizes a constant."""
    value = node.inputs[0]
    return stored(value) or (is_quantized(value) and _only_stored(value))


@_rule("bias-pair", error, nodes_of)
def biases(node: ir.Node) -> str | None:
    """Check that biases are float: no pair, no int32 before a DequantizeLinear."""
    biased = node.op_type in (*graph.CONVOLUTIONS, "Gemm")
    if biased and is_dequantized(graph.bias_of(node)):
        return "the bias is quantized, must be float"
    return None


@_rule("scalar-pair", error)
def scalars(node: ir.Node) -> str | None:
    """Check that quantized tensors have at least one dimension."""
    scalar = graph.static_shape(node.inputs[0]) == ()
    return f"{node.op_type} of a 0-D tensor" if scalar else None


def completeness(model: ir.Model) -> Iterator[LintFinding]:
    """Check that only DequantizeLinears of the same scale read a QuantizeLinear.

    A plugin that takes int8, and its scale as another input, may also read it.
    """
    for node in pairs_of(model):
        for message in _unpaired(node):
            yield error("unpaired", node, message)


def _unpaired(node: ir.Node) -> Iterator[str]:
    """Say what lacks of one node of a pair."""
    source, result = node.inputs[0], node.outputs[0]
    if node.op_type != QUANTIZE:
        if not stored(source) and not is_quantized(source):
            made = graph.producer_of(source)
            what = "a graph input" if made is None else made.op_type
            yield f"reads integers of {what}"
        return
    if result.is_graph_output():
        yield "its integers are a graph output"
    readers = list(result.consumers())
    for reader in readers:
        # A plugin may take int8 features, and have their scale.
        plugin = find(reader) if int8_inputs(reader) else None
        at = None if plugin is None else plugin[1].int8_scale
        if at is not None and graph.input_at(reader, at) is not None:
            continue
        if reader.op_type != DEQUANTIZE or not is_standard(reader):
            yield f"its integers are read by {reader.op_type}"
            continue
        left, right = (graph.array_of(each.inputs[1]) for each in (node, reader))
        if left is not None and right is not None and not np.array_equal(left, right):
            yield "quantized and dequantized on two scales"
    if not readers and not result.is_graph_output():
        yield "nothing reads its integers"


@_rule("integer-pair", error, nodes_of)
def integers(node: ir.Node) -> str | None:
    """Check that indices and shapes are not computed from dequantized numbers."""
    if node.op_type != "Cast" or not is_dequantized(node.inputs[0]):
        return None
    whole = (ir.DataType.INT32.value, ir.DataType.INT64.value)
    if node.attributes.get_int("to", 0) not in whole:
        return None
    return "a dequantized tensor is cast to an index or shape"


def channel_scales(model: ir.Model) -> Iterator[LintFinding]:
    """Check that activations have one scale, and weights one or one per channel."""
    for node in pairs_of(model):
        scale = graph.static_shape(node.inputs[1])
        # One scale is always allowed.
        if not scale or scale == (1,):
            continue
        if len(scale) > 1:
            if not _is_by_block(node):
                where = f"scales of shape {list(scale)}: by block"
                yield error("channel-scale", node, where)
        elif not _is_weight(node):
            yield error("channel-scale", node, "an activation has one scale a channel")
        elif "axis" not in node.attributes:
            yield error("weight-axis", node, "no axis: ONNX takes 1, TensorRT takes 0")
        elif node.op_type == DEQUANTIZE:
            for message in _wrong_axes(node, scale):
                yield error("weight-axis", node, message)


def _is_by_block(node: ir.Node) -> bool:
    """Return whether a pair is that of an int4 weight, whose scales are by block."""
    blocks = node.attributes.get_int("block_size", 0)
    return stored_type(node) == ir.DataType.INT4 and blocks > 0 and _is_weight(node)


def _wrong_axes(node: ir.Node, scale: tuple[int, ...]) -> Iterator[str]:
    """Say where scales run along another axis than that of the output channels."""
    shape, axis = graph.static_shape(node.inputs[0]), node.attributes.get_int("axis", 1)
    if shape is None:
        return
    axis += len(shape) if axis < 0 else 0
    if axis >= len(shape) or shape[axis] != scale[0]:
        yield f"{scale[0]} scales along axis {axis} of {list(shape)}"
        return
    # The axis must be that of each reader's channels.
    for reader in node.outputs[0].consumers():
        if reader.op_type in WEIGHTED and reader.inputs[1] is node.outputs[0]:
            wanted = graph.channel_axis(reader)
            if axis != wanted:
                yield (
                    f"scales along axis {axis}; output channels of {reader.op_type}"
                    f" run along {wanted}"
                )


@_rule("repeated-pair", warning)
def repeated_pairs(node: ir.Node) -> str | None:
    """Find tensors that are quantized twice in a row."""
    repeated = node.op_type == QUANTIZE and is_dequantized(node.inputs[0])
    return "quantizes what was just dequantized" if repeated else None


def outputs(model: ir.Model) -> Iterator[LintFinding]:
    """Find outputs of the graph that are rounded to int8."""
    for value in model.graph.outputs:
        if is_dequantized(value):
            yield warning(
                "output-pair", value.producer(), f"graph output {value.name} is rounded"
            )


@_rule("residual-branch", warning, nodes_of)
def branches(node: ir.Node) -> str | None:
    """Find pairs between a convolution and its Add: only the residual may have one."""
    if node.op_type != "Add" or not is_standard(node):
        return None
    if any(map(_is_convolution, node.inputs)):
        return None
    for value in node.inputs:
        # A pair of a convolution that nothing else reads.
        if value is None or not is_dequantized(value) or len(value.uses()) != 1:
            continue
        dequantize = value.producer()
        assert dequantize is not None
        quantize = graph.producer_of(dequantize.inputs[0])
        source = None if quantize is None else quantize.inputs[0]
        if _is_convolution(source) and source is not None and len(source.uses()) == 1:
            return "a pair between a convolution and its Add keeps the two from fusing"
    return None


@_rule("half-quantized", warning, nodes_of)
def half_quantized(node: ir.Node) -> str | None:
    """Find layers with only one int8 operand.

    A matrix-vector product may have a float activation: its weight decides its speed.
    """
    if node.op_type not in WEIGHTED or not is_standard(node):
        return None
    # Tell which operand is float: the remedy differs.
    sides = [is_dequantized(value) for value in node.inputs[:2]]
    if sides == [True, False]:
        return "its weight is float: it runs in float"
    if sides != [False, True]:
        return None
    if not _only_stored(node.inputs[1]):
        return "only one operand is int8"
    # int4 is for the weight alone, and pays where reading that takes the time
    pair = graph.producer_of(node.inputs[1])
    if pair is not None and _is_by_block(pair):
        return None
    product = node.op_type in ("Gemm", "MatMul")
    if product and extent(node, weight=True).is_vector:
        return None
    return "its activation is float: it runs in float"


@_rule("float-weight", warning)
def float_weights(node: ir.Node) -> str | None:
    """Find weights stored as float and quantized when the engine is built."""
    floats = node.op_type == QUANTIZE and stored(node.inputs[0])
    return "the weight is stored as float" if floats else None


def _only_stored(value: ir.Value | None) -> bool:
    """Return whether a value is a constant, possibly through pairs."""
    node = graph.producer_of(value)
    if node is not None and node.op_type in PAIR:
        return _only_stored(node.inputs[0])
    return stored(value)


def _is_convolution(value: ir.Value | None) -> bool:
    node = graph.producer_of(value)
    return node is not None and node.op_type in CONVOLUTIONS


RULES: tuple[LintRule, ...] = (
    scales,
    zero_points,
    biases,
    scalars,
    completeness,
    integers,
    channel_scales,
    repeated_pairs,
    outputs,
    branches,
    half_quantized,
    float_weights,
)
