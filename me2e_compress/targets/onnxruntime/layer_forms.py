"""Layers in the forms for which onnxruntime has int8 kernels on the CPU."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.targets.onnxruntime.gemm import write_gemm
from me2e_compress.targets.onnxruntime.kernels import bias_of, biased_end
from me2e_compress.targets.onnxruntime.writer import Writer
from me2e_compress.targets.weights import QuantizedWeight

BIAS_MAX = 2**30
"""Largest int32 bias: half the accumulator stays for the products, which need at most
127 * 255 * K: enough for K up to 33,000."""

Floats = npt.NDArray[np.float32]


def write_layer(
    writer: Writer, node: ir.Node, weight: QuantizedWeight, step: np.float32
) -> None:
    """Let a layer read its int8 weight, and an int32 bias.

    ==================  ==============================================================
    Conv                stays one: QLinearConv
    Gemm                stays one: QGemm
    MatMul, then Add    becomes a Gemm of two dimensions: QGemm. onnxruntime fuses the
                        two before it looks for int8, and then finds nothing
    MatMul              stays one, of any rank: MatMulIntegerToFloat
    ==================  ==============================================================

    Args:
        writer: of the graph.
        node: the Conv, Gemm or MatMul.
        weight: its weight.
        step: of the uint8 tensor it reads.
    """
    channels = len(weight.scales)
    bias = _bias(node, channels)
    if bias is None:
        _store(writer, node, 1, weight)
        return
    weight, integers = with_bias(weight, bias, step)
    units = (weight.scales * step).astype(np.float32)
    if node.op_type == "MatMul":
        node = write_gemm(writer, node, weight.integers.shape)
    _store(writer, node, 1, weight)
    fresh = writer.dequantized(f"{weight.name}_bias", integers, units, 0, node)
    node.replace_input_with(2, fresh)


def with_bias(
    weight: QuantizedWeight, bias: Floats, step: np.float32
) -> tuple[QuantizedWeight, npt.NDArray[np.int32]]:
    """Round a bias to int32 in units of ``step * weight.scales``.

    Where a channel's weights are so small that its bias does not fit, the channel gets
    a coarser scale: its products are below the bias's own rounding then.
    """
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
    """Read the bias of a layer, as one number a channel; None if it has none."""
    if node.op_type == "MatMul":
        end = biased_end(node)
        value = None if end is None else _other(end, node.outputs[0])
    else:
        value = bias_of(node)
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
