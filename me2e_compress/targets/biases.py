"""Biases of quantized layers, and the least scales of weights beside them."""

import dataclasses
import math

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.graph.nodes import array_of, sole_reader, unrenamed
from me2e_compress.graph.shapes import extent
from me2e_compress.targets.weights import QuantizedWeight, requantized

BIAS_MAX = 2**30
"""Largest int32 bias: half the accumulator is left for the products, which need at most
127 * 255 * K: enough for K up to 33,000."""

Floats = npt.NDArray[np.float32]


def is_bias(value: ir.Value | None, rank: int, columns: int | None) -> bool:
    """Return whether a value is a constant that adds one number to every column."""
    # A higher rank or more columns would change the product's shape.
    array = _stored(value)
    return (
        array is not None
        and array.ndim <= rank
        and math.prod(array.shape[:-1]) == 1
        and array.size in (1, columns)
        and array.dtype in (np.float32, np.float16)
    )


def biased_end(product: ir.Node) -> ir.Node | None:
    """Return the Add of a bias to a MatMul; None if others read the product."""
    addition = sole_reader(product.outputs[0])
    rank = graph.rank_of(product.inputs[0]) or 0
    if addition is None or addition.op_type != "Add":
        return None
    # The other operand must be a plain bias.
    columns = extent(product, weight=True).columns
    return addition if is_bias(_other(addition, product), rank, columns) else None


def bias_by_channel(node: ir.Node, channels: int | None) -> Floats | None:
    """Read the bias of a layer: float32 [channels]; None if none is stored.

    That of a MatMul is what the Add behind it adds. It is as long as it is stored where
    ``channels`` is None.
    """
    if node.op_type == "MatMul":
        end = biased_end(node)
        value = None if end is None else _other(end, node)
    else:
        value = graph.bias_of(node)
    array = _stored(value)
    if array is None:
        return None
    bias = array.astype(np.float32).reshape(-1)
    if channels is None or bias.size == channels:
        return bias
    return np.broadcast_to(bias, (channels,)) if bias.size == 1 else None


def least_scales(bias: Floats, step: np.float32) -> npt.NDArray[np.float64]:
    """Return the least scales of a weight beside which a bias fits into int32.

    A kernel adds the bias to its int32 sums in units of ``step * scale``, where
    ``step`` is the scale of the activation: onnxruntime rounds a float bias so, too,
    and one that does not fit wraps around. So |bias| <= BIAS_MAX * step * scale.
    """
    return np.abs(bias.astype(np.float64)) / (np.float64(BIAS_MAX) * step)


def with_room(
    weight: QuantizedWeight, least: npt.NDArray[np.float64]
) -> QuantizedWeight:
    """Raise the scales of a weight to the least ones, [channels]; itself if they are.

    The weights of a raised channel are rounded to fewer integers, down to 0 for a dead
    one. That is harmless: a product of K summands, each off by half a step at most, is
    off by K * 127 / 2 steps, 6e-8 * K of the bias that raised the scale to 2^-30 of it.
    """
    floor = least if weight.axis is not None else least.max(initial=0.0)
    scales = np.maximum(weight.scales, floor).astype(np.float32)
    if not (scales > weight.scales).any():
        return weight
    integers = requantized(weight.integers, weight.scales, scales, weight.axis)
    return dataclasses.replace(weight, integers=integers, scales=scales)


def _other(addition: ir.Node, product: ir.Node) -> ir.Value | None:
    left, right = addition.inputs
    return right if left is product.outputs[0] else left


def _stored(value: ir.Value | None) -> npt.NDArray[np.generic] | None:
    return None if value is None else array_of(unrenamed(value))
