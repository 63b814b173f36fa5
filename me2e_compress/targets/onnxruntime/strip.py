"""Read a graph that was quantized for TensorRT: explicit, symmetric int8 pairs."""

import onnx_ir as ir

from me2e_compress import graph, rewrite
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.errors import PreconditionError
from me2e_compress.rewrite import can_replace
from me2e_compress.targets.onnxruntime.draft import Draft
from me2e_compress.targets.onnxruntime.kernels import LAYERS, is_layer
from me2e_compress.targets.onnxruntime.stored_constants import (
    DEQUANTIZE,
    QUANTIZE,
    bias_of,
    step_of,
    weight_of,
)


def draft_of_qdq(model: ir.Model) -> Draft:
    """Copy a quantized graph without the pairs of its activations.

    A layer is to be int8 if both its input and its weight came through a pair, and
    there is a kernel for it: weights
    stored as int8 or, as ModelOpt writes them, in float behind a QuantizeLinear. Biases
    that are stored as int32 become float again.

    Args:
        model: the quantized graph; it stays as it is.

    Raises:
        PreconditionError: no activation is quantized, or a pair is not symmetric int8
            with float32 scales, one for an activation.
    """
    copy = model.clone()
    graph.infer_shapes(copy)
    pairs = {node: value for node in copy.graph if (value := _activation(node))}
    if not pairs:
        raise PreconditionError(
            "the graph has no quantized activation; lower a graph with int8 pairs, or"
            " quantize a float one for this target"
        )
    reach = {value: _reach(node) for node, value in pairs.items()}
    layers = [
        node
        for node in copy.graph
        if node.op_type in LAYERS and _maker(node.inputs[0]) in pairs
    ]
    for node in layers:
        bias = bias_of(node)
        if bias is not None:
            name = f"{node.inputs[2].name}_stored" if node.inputs[2] else ""
            node.replace_input_with(2, rewrite.add_constant(copy.graph, bias, name))
    weights = {node: weight_of(node) for node in layers if is_layer(node)}
    for node, value in pairs.items():
        if can_replace(node.outputs[0], value):
            rewrite.replace_value(node.outputs[0], value)
    rewrite.sweep(copy)
    return Draft(
        copy,
        {str(n.outputs[0].name): w for n, w in weights.items() if w is not None},
        {str(value.name): end for value, end in reach.items()},
    )


def _maker(value: ir.Value | None) -> ir.Node | None:
    return None if value is None else value.producer()


def _activation(node: ir.Node) -> ir.Value | None:
    """Give the tensor that a DequantizeLinear stands for, if it is no constant."""
    quantize = _maker(node.inputs[0]) if node.op_type == DEQUANTIZE else None
    if quantize is None or quantize.op_type != QUANTIZE:
        return None
    value = quantize.inputs[0]
    return value if graph.array_of(value) is None else None


def _reach(dequantize: ir.Node) -> float:
    """Read the largest magnitude on a pair's grid.

    Raises:
        PreconditionError: the pair has several scales.
    """
    step = step_of(dequantize)
    if step.size != 1:
        raise PreconditionError(
            f"{dequantize.name} has {step.size} scales: onnxruntime's kernels take one"
            " for an activation"
        )
    return float(step.reshape(())) * QUANT_MAX
