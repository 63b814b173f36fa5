"""Facts of weighted layers: which operators they are, bias, channels of the weight."""

import onnx_ir as ir

from me2e_compress.graph.nodes import input_at

CONVOLUTIONS = ("Conv", "ConvTranspose")
WEIGHTED = (*CONVOLUTIONS, "Gemm", "MatMul")
"""Operators of weighted layers: those that have an int8 kernel worth feeding."""


def bias_of(node: ir.Node) -> ir.Value | None:
    """Return the bias of a Conv, ConvTranspose or Gemm; None if it has none."""
    return input_at(node, 2)


def channel_axis(node: ir.Node) -> int:
    """Return the axis of a layer's weight along which its output channels run.

    Conv [M, C/g, ...]: 0. ConvTranspose [C, M/g, ...]: 1. MatMul [..., K, N]: the last.
    Gemm [K, N]: 1, or 0 where it is transposed.
    """
    if node.op_type == "Conv":
        return 0
    if node.op_type == "ConvTranspose":
        return 1
    if node.op_type == "Gemm":
        return 0 if node.attributes.get_int("transB", 0) else 1
    weight = node.inputs[1]
    rank = 2 if weight is None or weight.shape is None else len(weight.shape)
    return rank - 1
