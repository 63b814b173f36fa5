"""Quantize the planned weights to int8, one scale per channel."""

import dataclasses
import math
from collections.abc import Iterable, Sequence
from typing import TypeVar

import numpy as np
import numpy.typing as npt
import onnx_ir as ir

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError
from me2e_compress.calibration.observers import QUANT_MAX
from me2e_compress.graph import CONVOLUTIONS, producer_of, rewrite
from me2e_compress.graph.nodes import array_of, sole_reader, unrenamed
from me2e_compress.graph.shapes import extent
from me2e_compress.quantization.decision import Decision
from me2e_compress.runtime.frames import Array
from me2e_compress.runtime.session import run_once

Stored = TypeVar("Stored", bound=np.generic)  # the type of stored integers


@dataclasses.dataclass(frozen=True)
class QuantizedWeight:
    """A weight on the symmetric int8 grid: ``integers * scales`` along an axis.

    The integers have the weight's shape; a MatMul's [1, ..., K, N] becomes [K, N].
    """

    name: str  # base name of its initializers
    integers: npt.NDArray[np.int8]
    scales: npt.NDArray[np.float32]  # (channels,), or () for one step everywhere
    axis: int | None  # of the channels; None without


def weights_of(
    model: ir.Model, chosen: Iterable[Decision], *, balanced: bool = False
) -> dict[str, QuantizedWeight]:
    """Quantize the weights of int8 layers, by the name of the layer's first output.

    Layers that share a weight share the result; decisions without a weight are ignored.
    The graph needs opset 13 or later. ``balanced``: see :func:`balanced_steps`.
    """
    # Find the weight of each planned layer, and its channel axis: -1 for a MatMul.
    nodes = {str(node.outputs[0].name): node for node in model.graph}
    layers = dict[str, tuple[ir.Value, int | None]]()
    plain = set[tuple[ir.Value, int | None]]()
    for decision in chosen:
        if decision.weight is None:
            continue
        node, axis = nodes[decision.output], decision.axis
        weight = node.inputs[decision.weight]
        assert weight is not None
        layer = weight, -1 if axis is not None and node.op_type == "MatMul" else axis
        layers[decision.output] = layer
        # The errors of a weight add up over neighbouring pixels, and over elements that
        # are never negative. Over tokens of both signs, behind a LayerNormalization,
        # balance only adds to the errors: on the driver such products lose up to 1.7
        # dB, while products behind a ReLU and convolutions gain 0.2 to 8.6, but for
        # one that loses 0.2 (``python -m benchmarks.measure.weights``).
        producer = producer_of(node.inputs[0])
        behind_relu = producer is not None and producer.op_type == "Relu"
        if node.op_type not in CONVOLUTIONS and not behind_relu:
            plain.add(layer)
    # Weights that nodes compute are evaluated together.
    values = dict.fromkeys(value for value, _ in layers.values())
    names = [str(value.name) for value in values if value.producer() is not None]
    computed = evaluate_constants(model, names)
    # Quantize each weight once
    quantized = dict[tuple[ir.Value, int | None], QuantizedWeight]()
    for layer in dict.fromkeys(layers.values()):
        value, axis = layer
        name = str(value.name)
        array = computed.get(name)
        if array is None and value.const_value is not None:
            array = value.const_value.numpy()
        if array is None:
            message = f"{name} is planned as a weight, but is not a constant"
            raise PreconditionError(message)
        # A batch of one matrix is stored as that matrix
        if axis == -1:
            array, axis = array.reshape(array.shape[-2:]), 1
        is_balanced = balanced and layer not in plain
        pair = quantize_weight(array.astype(np.float32), axis, balanced=is_balanced)
        quantized[layer] = QuantizedWeight(name, *pair, axis)
    return {output: quantized[layer] for output, layer in layers.items()}


def quantize_weight(
    weight: npt.NDArray[np.float32], axis: int | None, *, balanced: bool = False
) -> tuple[npt.NDArray[np.int8], npt.NDArray[np.float32]]:
    """Round a weight to symmetric int8, with one scale per index of an axis, or one.

    ``scale = max|w| / 127`` over everything but the axis, ``q = round(w / scale)``,
    ties to even, as QuantizeLinear rounds; ``balanced`` by :func:`balanced_steps`, if
    there are channels. The scale of an all-zero channel is 1. Returns int8 of the same
    shape, and float32 [channels], or [] without an axis.
    """
    # One step per channel: max|w| / 127 over every other axis
    others = tuple(other for other in range(weight.ndim) if other != axis)
    reach = np.abs(weight).max(axis=others, initial=0.0, keepdims=True)
    steps = np.asarray(reach / np.float32(QUANT_MAX), np.float32)
    steps[steps == 0] = 1
    exact = weight / steps
    rounded = np.rint(exact)
    if balanced and axis is not None and exact.size:
        first = np.moveaxis(exact, axis, 0)  # (outputs, inputs, *kernel)
        kernels = first.reshape(*first.shape[:2], -1)
        rounded = np.moveaxis(balanced_steps(kernels).reshape(first.shape), 0, axis)
    integers = np.clip(rounded, -QUANT_MAX, QUANT_MAX).astype(np.int8)
    return integers, steps.reshape(() if axis is None else -1)


def requantized(
    integers: npt.NDArray[Stored],
    scales: Array,
    fresh: Array,
    axis: int | None,
    zero: Array | None = None,
) -> npt.NDArray[Stored]:
    """Round integers of some scales to other scales, in the same type.

    Args:
        integers: of any shape; ``(integer - zero) * scale`` is what they stand for.
        scales: [channels] along ``axis``, or [] for all.
        fresh: the other ones, of the same shape, above 0.
        axis: the axis of the channels; None without channels.
        zero: their zero points, of the same shape; None for 0.
    """
    shape = [1] * integers.ndim
    if axis is not None and scales.size > 1:
        shape[axis] = -1
    # (q - zero) scale = (q' - zero) fresh, so q' = (q - zero) scale / fresh + zero
    ratio = (scales.astype(np.float64) / fresh.astype(np.float64)).reshape(shape)
    centre = np.zeros(1) if zero is None else zero.astype(np.float64).reshape(shape)
    kind = np.iinfo(integers.dtype.name)
    moved = np.rint((integers.astype(np.float64) - centre) * ratio) + centre
    return np.clip(moved, kind.min, kind.max).astype(integers.dtype)


def scales_in(
    scales: npt.NDArray[np.float32], kind: npt.DTypeLike
) -> npt.NDArray[np.floating]:
    """Round scales to a floating-point type, but none to 0."""
    # Below its smallest normal number, 2^-14 of float16, a type has fewer digits, and
    # none below its smallest one, 2^-24: such scales are rounded up, so that integers
    # of theirs, rounded again (`requantized`), still fit
    near = scales.astype(kind)
    below = near.astype(np.float64) < scales
    few = scales < np.finfo(near.dtype).smallest_normal
    above = np.nextafter(near, near.dtype.type(np.inf))
    return np.asarray(np.where(below & few, above, near), near.dtype)


def balanced_steps(exact: npt.NDArray[np.float32]) -> npt.NDArray[np.float64]:
    """Round a weight [outputs, inputs, elements] so that its errors cancel."""
    # Neighbouring pixels are alike, and behind a ReLU all inputs are positive: errors
    # of one sign add up to a shift that no average over pixels removes. So elements
    # that lie near the middle between two integers are rounded the other way, those
    # first whose own error grows least, until the errors of a kernel, then those of an
    # output channel, sum to half a step at most. No element moves by a step or more.
    #
    # It is SQuant's rounding (Guo et al., ICLR 2022, arXiv 2202.07471), in one pass
    # over kernels and one over channels. It needs no frames.
    wide = exact.astype(np.float64)
    steps: npt.NDArray[np.float64] = np.rint(wide)
    error: npt.NDArray[np.float64] = steps - wide
    # The elements of a kernel: its errors sum to half a step at most
    moved = _excess(error)
    steps, error = steps - moved, error - moved
    # The kernels of a channel: each moves one element, that of the largest error
    moved = _excess(error.sum(2))[..., None]  # (outputs, inputs, 1)
    at = (error * moved).argmax(2)[..., None]
    np.put_along_axis(steps, at, np.take_along_axis(steps, at, 2) - moved, 2)
    return steps


def _excess(error: npt.NDArray[np.float64]) -> npt.NDArray[np.float64]:
    """Return what to subtract so that rows of errors sum to 1/2 at most: -1, 0, 1."""
    # Errors are at most a half, so enough of them have the sign of their sum
    total = error.sum(-1, keepdims=True)
    sign = np.sign(total)
    # The round(|total|) largest errors of its sign move by one step
    order = np.argsort(-error * sign, axis=-1, kind="stable")
    first = np.arange(error.shape[-1]) < np.rint(np.abs(total))
    excess = np.empty_like(error)
    np.put_along_axis(excess, order, np.where(first, sign, 0.0), -1)
    return excess


def evaluate_constants(model: ir.Model, names: Sequence[str]) -> dict[str, Array]:
    """Compute values that :func:`~me2e_compress.graph.nodes.constant_values` lists.

    Raises:
        GraphError: onnxruntime cannot compute them.
        FramesError: one of them depends on an input after all.
    """
    if not names:
        return {}
    # Cut a copy of the graph down to the wanted values and run it.
    part = model.clone()
    part.metadata_props.clear()  # it speaks of inputs and outputs that go
    values = {str(value.name): value for n in part.graph for value in n.outputs}
    part.graph.outputs.clear()
    part.graph.outputs.extend(values[name] for name in names)
    rewrite.sweep(part)
    used = [value for value in part.graph.inputs if value.uses()]
    part.graph.inputs.clear()
    part.graph.inputs.extend(used)
    return run_once(part, {})


# Biases of quantized layers, and the least scales of weights beside them.


# Largest int32 bias: half the accumulator is left for the products, which need at most
# 127 * 255 * K: enough for K up to 33,000
BIAS_MAX = 2**30

Floats = npt.NDArray[np.float32]


def is_bias(value: ir.Value | None, rank: int, columns: int | None) -> bool:
    """Return whether a value is a constant that adds one number to every column."""
    # A higher rank or more columns would change the product's shape.
    array = None if value is None else array_of(unrenamed(value))
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
    return addition if is_bias(_added(addition, product), rank, columns) else None


def bias_by_channel(node: ir.Node, channels: int | None) -> Floats | None:
    """Read the bias of a layer: float32 [channels]; None if none is stored.

    That of a MatMul is what the Add behind it adds. It is as long as it is stored where
    ``channels`` is None.
    """
    if node.op_type == "MatMul":
        end = biased_end(node)
        value = None if end is None else _added(end, node)
    else:
        value = graph.bias_of(node)
    array = None if value is None else array_of(unrenamed(value))
    if array is None:
        return None
    bias = array.astype(np.float32).reshape(-1)
    if channels is None or bias.size == channels:
        return bias
    return np.broadcast_to(bias, (channels,)) if bias.size == 1 else None


def least_scales(bias: Floats, step: np.float32) -> npt.NDArray[np.float64]:
    """Return the least scales of a weight beside which a bias fits into int32."""
    # A kernel adds the bias to its int32 sums in units of `step * scale`, where `step`
    # is the scale of the activation: onnxruntime rounds a float bias so, too, and one
    # that does not fit wraps around. So |bias| <= BIAS_MAX * step * scale.
    return np.abs(bias.astype(np.float64)) / (np.float64(BIAS_MAX) * step)


def with_room(
    weight: QuantizedWeight, least: npt.NDArray[np.float64]
) -> QuantizedWeight:
    """Raise the scales of a weight to at least the given ones, [channels]."""
    # The weights of a raised channel are rounded to fewer integers, down to 0 for a
    # dead one. That is harmless: a product of K summands, each off by half a step at
    # most, is off by K * 127 / 2 steps, 6e-8 * K of the bias that raised the scale to
    # 2^-30 of it.
    floor = least if weight.axis is not None else least.max(initial=0.0)
    scales = np.maximum(weight.scales, floor).astype(np.float32)
    if not (scales > weight.scales).any():
        return weight
    integers = requantized(weight.integers, weight.scales, scales, weight.axis)
    return dataclasses.replace(weight, integers=integers, scales=scales)


def _added(addition: ir.Node, product: ir.Node) -> ir.Value | None:
    left, right = addition.inputs
    return right if left is product.outputs[0] else left
