"""Rewrite layers to the forms for which onnxruntime's CPU has int8 kernels.

A product between uint8 tensors becomes a convolution: on one core with VNNI,
onnxruntime 1.31 computes [10000, 256] x [256, 512] at 200 GMAC/s as a QGemm, and at 440
to 470 as a QLinearConv over pixels (``benchmarks/measure/int8_shapes.py``).
"""

import dataclasses
import math
from collections.abc import Sequence

import numpy as np
import onnx_ir as ir

from me2e_compress.base.errors import PreconditionError
from me2e_compress.graph import rank_of, rewrite
from me2e_compress.graph.nodes import sole_reader
from me2e_compress.operators import FusedCall
from me2e_compress.operators.call import Size
from me2e_compress.targets.onnxruntime.region import end_of, reads_one_pixel
from me2e_compress.targets.quantized import QUANTIZE, Writer
from me2e_compress.targets.weights import (
    QuantizedWeight,
    bias_by_channel,
    biased_end,
    least_scales,
    with_room,
)

CHANNELS_SECOND, CHANNELS_LAST = (0, 3, 1, 2), (0, 2, 3, 1)


def write_layer(
    writer: Writer, node: ir.Node, weight: QuantizedWeight, step: np.float32
) -> None:
    """Rewrite a layer to read its int8 weight and an int32 bias.

    ==================  ==============================================================
    Conv                remains: QLinearConv
    Conv of one pixel   becomes a Gemm, unless it is read as uint8 only
    read as uint8 only  becomes a Conv: QLinearConv
    Gemm                remains: QGemm
    MatMul, then Add    becomes a Gemm of two dimensions: QGemm. onnxruntime fuses the
                        two before it looks for int8, and then finds nothing
    MatMul              remains, of any rank: MatMulIntegerToFloat
    ==================  ==============================================================

    ``step`` is the scale of the uint8 tensor that the layer reads.
    """
    # Round the bias to int32 in units of step * scale: a channel whose weights are so
    # small that its bias does not fit gets a coarser scale, and its products are then
    # below the bias's own rounding
    bias, integers = bias_by_channel(node, len(weight.scales)), None
    if bias is not None:
        roomy = with_room(weight, least_scales(bias, step))
        if roomy is not weight:
            weight = dataclasses.replace(roomy, name=f"{weight.name}_coarse")
        rounded = np.rint(bias / (weight.scales.astype(np.float64) * step))
        integers = rounded.astype(np.int32)
    # Does a QuantizeLinear alone read it, behind bias and ReLU?
    left = node.inputs[0]
    reader = sole_reader(end_of(_last_of(node)))
    known = left is not None and left.shape is not None
    quantize = reader if known and reader and reader.op_type == QUANTIZE else None
    # Choose the form.
    if node.op_type == "Conv":
        if quantize is None and reads_one_pixel(node):
            matrix = weight.integers.reshape(weight.integers.shape[:2])
            name = f"{weight.name}_matrix"
            weight = dataclasses.replace(weight, name=name, integers=matrix)
            node = _write_row(writer, node, weight.integers.shape)
    elif quantize is not None:
        columns_first = node.attributes.get_int("transB", 0)
        matrix = weight.integers if columns_first else weight.integers.T
        filters = np.ascontiguousarray(matrix)[:, :, None, None]
        axis = None if weight.axis is None else 0
        name = f"{weight.name}_filter"
        weight = QuantizedWeight(name, filters, weight.scales, axis)
        node = _write_convolution(writer, node, quantize, filters.shape)
    elif node.op_type == "MatMul" and bias is not None:
        node = _write_gemm(writer, node, weight.integers.shape)
    # Write the weight, and the bias in units of the product's steps.
    fresh = writer.dequantized(
        weight.name, weight.integers, weight.scales, weight.axis, node
    )
    node.replace_input_with(1, fresh)
    if integers is None:
        node.resize_inputs(2)
    else:
        units = (weight.scales * step).astype(np.float32)
        fresh = writer.dequantized(f"{weight.name}_bias", integers, units, 0, node)
        node.replace_input_with(2, fresh)


def _write_gemm(writer: Writer, product: ir.Node, size: Sequence[int]) -> ir.Node:
    """Replace a MatMul and the Add after it by a Gemm of two dimensions.

    Given:   y = Add(MatMul(x, w), b)                           x [..., K], w [K, N]
    Result:  y = Reshape(Gemm(Reshape(x, [-1, K]), w, b), [..., N])

    ``size`` is (K, N). The weight and bias of the returned Gemm are still to be
    written.
    """
    addition = biased_end(product)
    left, right = product.inputs
    if addition is None or left is None or left.shape is None or right is None:
        raise PreconditionError(f"{product.name} is not a MatMul with a bias")
    old = addition.outputs[0]
    call = writer.call(addition, [product, addition])
    # Flatten the leading dimensions, and restore them afterwards
    ranked = len(left.shape) > 2
    rows = call.reshape(left, [-1, size[0]]) if ranked else left
    gemm = _layer(call, "Gemm", [rows, right, right])
    answer = gemm.outputs[0]
    if ranked:
        answer = call.reshape(answer, [*_leading(call, left), size[1]])
    # The result replaces that of the Add.
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm


def _layer(
    call: FusedCall,
    op_type: str,
    inputs: Sequence[ir.Value],
    attributes: dict[str, int] | None = None,
) -> ir.Node:
    """Insert a layer whose weight and bias are still to be written."""
    made = call.add(op_type, inputs, attributes)
    made.type, node = inputs[0].type, made.producer()
    assert node is not None
    return node


def _leading(call: FusedCall, value: ir.Value) -> list[Size]:
    """Return all dimensions of a value but the last."""
    return [call.size(value, axis) for axis in range((rank_of(value) or 1) - 1)]


def _write_row(writer: Writer, node: ir.Node, size: Sequence[int]) -> ir.Node:
    """Replace a convolution of one pixel by a Gemm.

    Given:   y = Conv(x, w, b)                      x [B, K, 1, 1], w [N, K, 1, 1]
    Result:  y = Reshape(Gemm<transB=1>(Reshape(x, [-1, K]), w', b), [-1, N, 1, 1])

    ``size`` is (N, K). The weight and bias of the returned Gemm are still to be
    written.
    """
    old, (image, weight) = node.outputs[0], node.inputs[:2]
    if image is None or weight is None:
        raise PreconditionError(f"{node.name} is not a convolution")
    ones, call = [1] * (rank_of(image) or 4), writer.call(node, [node])
    row = call.reshape(image, [-1, size[1]])
    gemm = _layer(call, "Gemm", [row, weight, weight], {"transB": 1})
    answer = call.reshape(gemm.outputs[0], [-1, size[0], *ones[2:]])
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm


def _write_convolution(
    writer: Writer, product: ir.Node, quantize: ir.Node, size: Sequence[int]
) -> ir.Node:
    """Replace a product that only a QuantizeLinear reads by a convolution.

    Given:   q = QuantizeLinear(Relu(Add(MatMul(DequantizeLinear(x), w), b)))
    Result:  q = Reshape(Transpose(QuantizeLinear(Relu(Conv(DequantizeLinear(
                 Transpose(Reshape(x, [1, -1, 1, K]))), w, b)))), [..., N])

    x is uint8 [..., K], ``size`` (N, K, ...). onnxruntime computes with the channels
    last, and so removes both transposes. The filter and the bias of the returned Conv
    are still to be written.
    """
    last = _last_of(product)
    left, weight = product.inputs[:2]
    assert left is not None
    assert left.shape is not None
    assert weight is not None
    dequantize = left.producer()
    assert dequantize is not None
    integers, *grid = [value for value in dequantize.inputs if value is not None]
    old, leading = last.outputs[0], list(left.shape)[:-1]
    columns, depth = size[:2]
    # Every row becomes a pixel, while it is uint8.
    call = writer.call(last, [product, last])
    pixels = call.reshape(integers, [1, -1, 1, depth])
    image = call.transpose(pixels, CHANNELS_SECOND)
    numbers = call.add("DequantizeLinear", [image, *grid])
    node = _layer(call, "Conv", [numbers, weight, weight])
    rewrite.replace_value(old, node.outputs[0])
    # All up to the QuantizeLinear has the shape of an image now.
    known = [dim for dim in leading if isinstance(dim, int)]
    rows = math.prod(known) if len(known) == len(leading) else None
    for value in (node.outputs[0], quantize.inputs[0], quantize.outputs[0]):
        assert value is not None
        value.shape = ir.Shape([1, columns, rows, 1])
    # The pixels become rows again behind it.
    answer, uses = quantize.outputs[0], list(quantize.outputs[0].uses())
    call = writer.call(uses[0].node, [product, last])
    turned = call.transpose(answer, CHANNELS_LAST)
    restored = call.reshape(turned, [*_leading(call, left), columns])
    restored.shape = ir.Shape([*leading, columns])
    for use in uses:
        use.node.replace_input_with(use.idx, restored)
    return node


def _last_of(product: ir.Node) -> ir.Node:
    """Return the Add of a MatMul's bias, or the product itself."""
    end = biased_end(product) if product.op_type == "MatMul" else None
    return end or product
