"""Placement of pairs: channels, branches of Adds, outputs, half-quantized layers."""

from collections.abc import Iterator

import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph import CONVOLUTIONS, WEIGHTED, is_standard, nodes_of
from me2e_compress.targets.base import LintFinding, error, warning
from me2e_compress.targets.quantized import (
    DEQUANTIZE,
    PAIR,
    QUANTIZE,
    is_dequantized,
    is_quantized,
    pairs_of,
)
from me2e_compress.targets.tensorrt.lint.qdq import stored


def channel_scales(model: ir.Model) -> Iterator[LintFinding]:
    """Check that activations have one scale, and weights one or one a channel."""
    for node in pairs_of(model):
        scale = graph.static_shape(node.inputs[1])
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
    axis += len(shape) if axis < 0 else 0
    if axis >= len(shape) or shape[axis] != scale[0]:
        yield error(
            "weight-axis", node, f"{scale[0]} scales along axis {axis} of {list(shape)}"
        )
        return
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
    """Find what is quantized twice in a row."""
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
    """Find pairs between a convolution and its Add: only the residual has one."""
    for node in nodes_of(model):
        if node.op_type != "Add" or not is_standard(node):
            continue
        rounded = [_rounds_convolution(value) for value in node.inputs]
        if any(rounded) and not any(_is_convolution(value) for value in node.inputs):
            yield warning(
                "residual-branch",
                node,
                "a pair between a convolution and its Add keeps the two from fusing",
            )


def half_quantized(model: ir.Model) -> Iterator[LintFinding]:
    """Find layers that read int8 on one side only."""
    for node in nodes_of(model):
        if node.op_type not in WEIGHTED or not is_standard(node):
            continue
        sides = [is_dequantized(value) for value in node.inputs[:2]]
        if sides == [True, False]:
            yield warning(
                "half-quantized", node, "its weight is float: it runs in float"
            )
        elif sides == [False, True] and not _only_stored(node.inputs[1]):
            yield warning("half-quantized", node, "only one operand is int8")
        elif sides == [False, True]:
            yield warning(
                "half-quantized", node, "its activation is float: it runs in float"
            )


def float_weights(model: ir.Model) -> Iterator[LintFinding]:
    """Find weights that are stored as float and quantized when the engine is built."""
    for node in pairs_of(model):
        value = node.inputs[0]
        if node.op_type == QUANTIZE and stored(value):
            yield warning("float-weight", node, "the weight is stored as float")


def _is_weight(node: ir.Node) -> bool:
    """Return whether a pair stands on a constant."""
    value = node.inputs[0]
    return stored(value) or (is_quantized(value) and _only_stored(value))


def _only_stored(value: ir.Value | None) -> bool:
    """Return whether a value is a constant, a pair at most in between."""
    node = graph.producer_of(value)
    if node is not None and node.op_type in PAIR:
        return _only_stored(node.inputs[0])
    return stored(value)


def _rounds_convolution(value: ir.Value | None) -> bool:
    """Return whether a pair reads a convolution that nothing else reads."""
    if value is None or not is_dequantized(value) or len(value.uses()) != 1:
        return False
    node = value.producer()
    quantize = None if node is None else graph.producer_of(node.inputs[0])
    source = quantize.inputs[0] if quantize is not None else None
    return _is_convolution(source) and source is not None and len(source.uses()) == 1


def _is_convolution(value: ir.Value | None) -> bool:
    node = graph.producer_of(value)
    return node is not None and node.op_type in CONVOLUTIONS
