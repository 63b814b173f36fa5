"""Rewrite layers to the forms for which onnxruntime's CPU has int8 kernels."""

from collections.abc import Sequence

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.graph import rewrite
from me2e_compress.targets.onnxruntime.convolution_form import (
    filter_of,
    quantize_of,
    write_convolution,
)
from me2e_compress.targets.onnxruntime.insertion import Place
from me2e_compress.targets.onnxruntime.kernels import biased_end
from me2e_compress.targets.weights import QuantizedWeight
from me2e_compress.targets.writer import Writer

BIAS_MAX = 2**30
"""Largest int32 bias: half the accumulator is left for the products, which need at most
127 * 255 * K: enough for K up to 33,000."""

Floats = npt.NDArray[np.float32]


def write_layer(
    writer: Writer, node: ir.Node, weight: QuantizedWeight, step: np.float32
) -> None:
    """Rewrite a layer to read its int8 weight and an int32 bias.

    ==================  ==============================================================
    Conv                remains: QLinearConv
    read as uint8 only  becomes a Conv: QLinearConv
    Gemm                remains: QGemm
    MatMul, then Add    becomes a Gemm of two dimensions: QGemm. onnxruntime fuses the
                        two before it looks for int8, and then finds nothing
    MatMul              remains, of any rank: MatMulIntegerToFloat
    ==================  ==============================================================

    ``step`` is the scale of the uint8 tensor that the layer reads.
    """
    bias = _bias(node, len(weight.scales))
    integers = None
    if bias is not None:
        weight, integers = with_bias(weight, bias, step)
    # Choose the form.
    quantize = quantize_of(node)
    if quantize is not None:
        weight = filter_of(node, weight)
        columns, depth = weight.integers.shape[:2]
        node = write_convolution(writer, node, quantize, (columns, depth))
    elif node.op_type == "MatMul" and bias is not None:
        node = _write_gemm(writer, node, weight.integers.shape)
    # Write the weight, and the bias in units of the product's steps.
    _store(writer, node, 1, weight)
    if integers is None:
        node.resize_inputs(2)
    else:
        units = (weight.scales * step).astype(np.float32)
        fresh = writer.dequantized(f"{weight.name}_bias", integers, units, 0, node)
        node.replace_input_with(2, fresh)


def with_bias(
    weight: QuantizedWeight, bias: Floats, step: np.float32
) -> tuple[QuantizedWeight, npt.NDArray[np.int32]]:
    """Round a bias to int32 in units of ``step * weight.scales``.

    If a channel's weights are so small that its bias does not fit, the channel gets a
    coarser scale: its products are then below the bias's own rounding.
    """
    # The scales at which the largest bias still fits.
    least = np.abs(bias) / (np.float64(BIAS_MAX) * step)
    scales = np.maximum(weight.scales, least).astype(np.float32)
    if (scales > weight.scales).any():
        shape = [1] * weight.integers.ndim
        if weight.axis is not None:
            shape[weight.axis] = -1
        ratio = (weight.scales / scales).reshape(shape)
        coarse = np.rint(weight.integers * ratio).astype(np.int8)
        weight = QuantizedWeight(f"{weight.name}_coarse", coarse, scales, weight.axis)
    integers = np.rint(bias / (weight.scales.astype(np.float64) * step))
    return weight, integers.astype(np.int32)


def _bias(node: ir.Node, channels: int) -> Floats | None:
    """Read the bias of a layer, one number a channel; None if it has none."""
    if node.op_type == "MatMul":
        end = biased_end(node)
        value = None if end is None else _other(end, node.outputs[0])
    else:
        value = graph.bias_of(node)
    array = graph.array_of(value)
    if array is None:
        return None
    return np.broadcast_to(array.astype(np.float32).reshape(-1), (channels,))


def _other(addition: ir.Node, known: ir.Value) -> ir.Value | None:
    left, right = addition.inputs
    return right if left is known else left


def _store(writer: Writer, node: ir.Node, index: int, weight: QuantizedWeight) -> None:
    fresh = writer.dequantized(
        weight.name, weight.integers, weight.scales, weight.axis, node
    )
    node.replace_input_with(index, fresh)


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
    name = str(old.name)
    place = Place(writer, addition, [product, addition])
    # Flatten the leading dimensions, and restore them afterwards.
    leading = list(left.shape)[:-1]
    rows = left
    if len(leading) > 1:
        rows = place.reshaped(left, [-1, size[0]], f"{name}_rows")
    gemm = place.node("Gemm", [rows, right, right], f"{name}_gemm")
    answer = gemm.outputs[0]
    if len(leading) > 1:
        answer = place.restored(answer, left, leading, size[1], name)
    # The result replaces that of the Add.
    answer.shape, answer.type = old.shape, old.type
    rewrite.replace_value(old, answer)
    return gemm
