"""Fuse patterns that one standard operator can express."""

import dataclasses
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import bias_of, channel_axis, opset_of, static_shape
from me2e_compress.graph.nodes import (
    FLOATS,
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
    fuse,
    op,
    var,
)
from me2e_compress.graph.rewrite.raise_opset import OLDEST_OPSET
from me2e_compress.passes.base import Context, Pass, PassResult


@dataclasses.dataclass(frozen=True)
class FuseBasic(Pass):
    """Fuse patterns of standard operators into fewer standard operators.

    Given:   Conv -> BatchNormalization -> Relu;  MatMul(x, w) + b of rank 2

    Result:  Conv -> Relu;  Gemm(x, w, b)

    Outputs are equal up to rounding. Gelu and LayerNormalization stay decomposed where
    they are: runtimes find them. A residual Conv + Add stays, in the form that TensorRT
    and onnxruntime fuse with the next activation.
    """

    name = "fuse-basic"
    exact = True

    def run(self, model: ir.Model, context: Context) -> PassResult:
        """Try every fusion on every node until none applies."""
        if opset_of(model) < OLDEST_OPSET:  # operators had other rules then
            return PassResult(model, 0)
        fused = fuse(model, FUSIONS, by=self.name)
        return PassResult(model, fused.changes, fused.notes())


# Fold scales and shifts around a layer into its weights: with y = k x + d per output
# channel, weight' = k weight and bias' = k bias + d, computed in float64 (Ioffe,
# Szegedy 2015 for the k and d of a normalization).

SHARED = var("weight")
LAYER = op(("Conv", "ConvTranspose", "Gemm"), var("x"), SHARED, more=True)
NUMBERS = constant()
# Gamma, beta, mean and variance.
STATISTICS = tuple(constant() for _ in range(4))

AFFINE = either(
    op("BatchNormalization", LAYER, *STATISTICS), op(("Add", "Mul"), LAYER, NUMBERS)
)


def _is_affine(match: Match, facts: Facts) -> bool:
    node = match.root
    if node.op_type != "BatchNormalization":
        return _affine(match) is not None
    training = node.attributes.get_int("training_mode", 0)
    outputs = [value for value in node.outputs[1:] if value.name]
    return not training and not outputs


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
    # Zero times a sum would lose the sign of its zeros
    return (numbers, zero) if numbers.all() else None


def _is_per_channel(match: Match) -> bool:
    source, constant_shape = match[LAYER], match.array(NUMBERS).shape
    shape = static_shape(source)
    rank = len(source.shape) if source.shape is not None else 0
    if len(constant_shape) > rank or rank < 2:
        return False
    if math.prod(constant_shape) == 1:
        return True
    full = (1,) * (rank - len(constant_shape)) + constant_shape
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


# MatMul and bias of rank 2 as a Gemm. At rank 3 they stay: Reshape, Gemm, Reshape would
# hide the product from attention patterns and misplace the quantizers.

LEFT, RIGHT, OFFSET = var("left"), var("right"), constant(floating=False)
INNER = op("MatMul", LEFT, RIGHT)
PLUS = op("Add", INNER, OFFSET)


def _is_of_matrices(match: Match, facts: Facts) -> bool:
    """Return whether the product has rank 2 and the offset varies only by column."""
    inner = match.node(INNER)
    if match.root.outputs[0].dtype not in FLOATS:
        return False
    left, right, out = map(static_shape, (*inner.inputs, *inner.outputs))
    if left is None or right is None or out is None:
        return False
    columns = out[-1:]
    added = match.array(OFFSET).shape
    return len(left) == len(right) == 2 and added in ((), (1,), columns, (1, *columns))


FUSIONS = (
    Fusion("layers with what follows them", AFFINE, _fold_affine, where=_is_affine),
    Fusion(
        "MatMul + bias",
        PLUS,
        lambda m, kit: kit.replace_by("Gemm", [m[LEFT], m[RIGHT], m[OFFSET]]),
        where=_is_of_matrices,
    ),
)
