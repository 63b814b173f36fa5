"""Fold scales and shifts around a layer into its weights.

::

    Given:   Conv (ConvTranspose, Gemm) -> BatchNormalization, or a constant Add, Mul
    Result:  one Conv with other weights

With y = k x + d per output channel: weight' = k weight, bias' = k bias + d, computed
in float64 (Ioffe, Szegedy 2015 for the k and d of a normalization). What stands behind
a layer whose weight others read, too, stays.
"""

import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import bias_of, channel_axis, static_shape
from me2e_compress.graph.nodes import (
    Numbers,
    holds_numbers,
    numbers_of,
    overflow,
    sole_reader,
)
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    constant,
    either,
    op,
    var,
)

# What follows a layer channel by channel.

SHARED = var("weight")
LAYER = op(("Conv", "ConvTranspose", "Gemm"), var("x"), SHARED, more=True)
NUMBERS = constant()
STATISTICS = tuple(constant() for _ in range(4))
"""Gamma, beta, mean and variance."""

AFFINE = either(
    op("BatchNormalization", LAYER, *STATISTICS),
    op(("Add", "Sub", "Mul", "Div"), LAYER, NUMBERS),
    op("Sub", NUMBERS, LAYER),
)


def _is_affine(match: Match, facts: Facts) -> bool:
    node = match.root
    if node.op_type != "BatchNormalization":
        return _affine(match) is not None
    training = node.attributes.get_int("training_mode", 0)
    outputs = [value for value in node.outputs[1:] if value.name]
    return not training and not outputs and facts.opset >= 9


def _affine(match: Match) -> tuple[Numbers, Numbers] | None:
    """Return scale and shift, one number per channel; None if they vary in one."""
    node = match.root
    if node.op_type == "BatchNormalization":
        gamma, beta, mean, variance = (match.numbers(part) for part in STATISTICS)
        epsilon = node.attributes.get_float("epsilon", 1e-5)
        scale = gamma / np.sqrt(variance + epsilon)
        return scale, beta - mean * scale
    if not _is_per_channel(match):
        return None
    numbers, one, zero = match.numbers(NUMBERS).reshape(-1), np.ones(1), np.zeros(1)
    if node.op_type == "Add":
        return one, numbers
    if node.op_type == "Sub":
        first = match[LAYER] is node.inputs[0]
        return (one, -numbers) if first else (-one, numbers)
    if not numbers.all():
        return None
    factor = numbers if node.op_type == "Mul" else 1 / numbers
    # zero times a sum would lose the sign of its zeros
    return (factor, zero) if factor.all() else None


def _is_per_channel(match: Match) -> bool:
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


def _fold_affine(match: Match, kit: Kit) -> str | None:
    layer, affine = match.node(LAYER), _affine(match)
    bias, what = _bias(layer), layer.op_type
    if affine is None or bias is None or not holds_numbers(match[SHARED]):
        return f"{what} whose weights are computed"
    # Compute the new weight and bias in float64
    stored, shift = match.array(SHARED), affine[1]
    scale = _per_output(layer, affine[0])
    weight = _scaled(layer, match.numbers(SHARED), scale)
    bias = np.broadcast_to(bias * scale + shift, scale.shape)
    if overflow(weight, stored) or overflow(bias, stored):
        return f"{what} whose weights would overflow"
    # Store them, unless others read the weight as it is
    name = match[SHARED].name or layer.name or "layer"
    if not (scale == 1).all():
        if sole_reader(match[SHARED]) is not layer:
            return f"{what} that shares its weights"
        kit.refill(layer, 1, weight.astype(stored.dtype), name)
    kit.refill(
        layer, 2, bias.astype(stored.dtype), f"{name.removesuffix('.weight')}.bias"
    )
    if what == "Gemm":
        layer.attributes["beta"] = ir.AttrFloat32("beta", 1.0)  # it is in the bias
    kit.absorb(layer)
    return None


def _per_output(layer: ir.Node, scale: Numbers) -> Numbers:
    """Return the scale of every output channel."""
    shape, groups = static_shape(layer.inputs[1]) or (1, 1), 1
    if layer.op_type == "ConvTranspose":
        groups = layer.attributes.get_int("group", 1)
    return np.broadcast_to(scale, (shape[channel_axis(layer)] * groups,))


def _bias(layer: ir.Node) -> Numbers | None:
    """Return the bias as a vector (zero if none); None if it is not a vector."""
    if bias_of(layer) is None:
        return np.zeros(1)
    bias = numbers_of(bias_of(layer))
    if bias is None or any(size != 1 for size in bias.shape[:-1]):
        return None
    beta = layer.attributes.get_float("beta", 1.0)
    return bias.reshape(-1) * (beta if layer.op_type == "Gemm" else 1.0)


def _scaled(layer: ir.Node, weight: Numbers, scale: Numbers) -> Numbers:
    if layer.op_type == "Gemm":
        flip = layer.attributes.get_int("transB", 0)
        return weight * (scale[:, None] if flip else scale)
    rest = (1,) * (weight.ndim - 2)
    if layer.op_type == "Conv":
        return weight * scale.reshape(-1, 1, *rest)
    groups = layer.attributes.get_int("group", 1)
    rows = np.repeat(scale.reshape(groups, -1), weight.shape[0] // groups, axis=0)
    return weight * rows.reshape(*rows.shape, *rest)


FUSIONS = (
    Fusion("layers with what follows them", AFFINE, _fold_affine, where=_is_affine),
)
