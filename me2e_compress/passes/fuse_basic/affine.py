"""What scales and shifts channels, folded into the layer before it.

Given:   Conv (ConvTranspose, Gemm) -> BatchNormalization, or a constant Add, Mul, ...
Result:  one Conv with other weights

With y = k x + d per output channel: weight' = k weight, bias' = k bias + d, computed
in float64 (Ioffe, Szegedy 2015 for the k and d of a normalization).
"""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import bias_of, channel_axis, static_shape
from me2e_compress.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    Numbers,
    constant,
    either,
    holds_numbers,
    numbers_of,
    op,
    overflow,
    sole_reader,
    var,
)

WEIGHT = var("weight")
LAYER = op(("Conv", "ConvTranspose", "Gemm"), var("x"), WEIGHT, more=True)
NUMBERS = constant()
STATISTICS = tuple(constant() for _ in range(4))
"""Gamma, beta, mean and variance."""

PATTERN = either(
    op("BatchNormalization", LAYER, *STATISTICS),
    op(("Add", "Sub", "Mul", "Div"), LAYER, NUMBERS),
    op("Sub", NUMBERS, LAYER),
)


@dataclasses.dataclass(frozen=True)
class _Affine:
    """``y = scale * x + shift``, one number a channel."""

    scale: Numbers
    shift: Numbers


def _is_affine(match: Match, facts: Facts) -> bool:
    node = match.root
    if node.op_type != "BatchNormalization":
        return _arithmetic(match) is not None
    training = node.attributes.get_int("training_mode", 0)
    outputs = [value for value in node.outputs[1:] if value.name]
    return not training and not outputs and facts.opset >= 9


def _affine(match: Match) -> _Affine | None:
    normalized = match.root.op_type == "BatchNormalization"
    return _normalization(match) if normalized else _arithmetic(match)


def _normalization(match: Match) -> _Affine:
    """Read an inference-time BatchNormalization."""
    gamma, beta, mean, variance = (match.numbers(part) for part in STATISTICS)
    epsilon = match.root.attributes.get_float("epsilon", 1e-5)
    scale = gamma / np.sqrt(variance + epsilon)
    return _Affine(scale, beta - mean * scale)


def _arithmetic(match: Match) -> _Affine | None:
    """Read a constant operand; None if it is not the same for a whole channel."""
    if not _is_per_channel(match):
        return None
    node, numbers = match.root, match.numbers(NUMBERS).reshape(-1)
    one, zero = np.ones(1), np.zeros(1)
    if node.op_type == "Add":
        return _Affine(one, numbers)
    if node.op_type == "Mul":
        return _Affine(numbers, zero)
    if node.op_type == "Sub":
        first = match[LAYER] is node.inputs[0]
        return _Affine(one, -numbers) if first else _Affine(-one, numbers)
    return _Affine(1 / numbers, zero) if numbers.all() else None


def _is_per_channel(match: Match) -> bool:
    """Return whether a constant differs along axis 1 at most."""
    source, given = match[LAYER], match.array(NUMBERS).shape
    shape = static_shape(source)
    rank = len(source.shape) if source.shape is not None else 0
    if len(given) > rank or rank < 2:
        return False
    if math.prod(given) == 1:
        return True
    full = (1,) * (rank - len(given)) + given
    if any(size != 1 for axis, size in enumerate(full) if axis != 1):
        return False
    same = shape == static_shape(match.root.outputs[0])
    return same and shape is not None and shape[1] == full[1]


def _rewrite(match: Match, kit: Kit) -> str | None:
    layer, affine = match.node(LAYER), _affine(match)
    bias, what = _bias(layer), layer.op_type
    if affine is None or bias is None or not holds_numbers(match[WEIGHT]):
        return f"{what} whose weights are computed"
    weight, stored = match.numbers(WEIGHT), match.array(WEIGHT)
    groups = layer.attributes.get_int("group", 1) if what == "ConvTranspose" else 1
    channels = weight.shape[channel_axis(layer)] * groups
    scale = np.broadcast_to(affine.scale, (channels,))
    weight = weight * _shaped(layer, weight, scale)
    bias = np.broadcast_to(bias * scale + affine.shift, (channels,))
    owned = sole_reader(match[WEIGHT]) is layer
    if not owned and not (scale == 1).all():
        return f"{what} that shares its weights"
    if overflow(weight, stored) or overflow(bias, stored):
        return f"{what} whose weights would overflow"
    name = match[WEIGHT].name or layer.name or "layer"
    if owned:  # else its scale is 1
        kit.refill(layer, 1, weight.astype(stored.dtype), name)
    kit.refill(
        layer, 2, bias.astype(stored.dtype), f"{name.removesuffix('.weight')}.bias"
    )
    if what == "Gemm":
        layer.attributes["beta"] = ir.AttrFloat32("beta", 1.0)  # it is in the bias
    kit.absorb(layer)
    return None


def _bias(layer: ir.Node) -> Numbers | None:
    """Return the bias as a vector (zero if there is none); None if it is not one."""
    if bias_of(layer) is None:
        return np.zeros(1)
    bias = numbers_of(bias_of(layer))
    if bias is None or any(size != 1 for size in bias.shape[:-1]):
        return None
    beta = layer.attributes.get_float("beta", 1.0)
    return bias.reshape(-1) * (beta if layer.op_type == "Gemm" else 1.0)


def _shaped(layer: ir.Node, weight: Numbers, scale: Numbers) -> Numbers:
    """Return the scale in the form in which it multiplies the weight."""
    if layer.op_type == "Gemm":
        return scale[:, None] if layer.attributes.get_int("transB", 0) else scale
    rest = (1,) * (weight.ndim - 2)
    if layer.op_type == "Conv":
        return scale.reshape(-1, 1, *rest)
    groups = layer.attributes.get_int("group", 1)
    rows = np.repeat(scale.reshape(groups, -1), weight.shape[0] // groups, axis=0)
    return rows.reshape(*rows.shape, *rest)


FUSION = Fusion("layers with what follows them", PATTERN, _rewrite, where=_is_affine)
