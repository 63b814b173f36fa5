"""Fold scales and shifts around a layer into its weights.

Channels behind a layer::

    Given:   Conv (ConvTranspose, Gemm) -> BatchNormalization, or a constant Add, Mul
    Result:  one Conv with other weights

With y = k x + d per output channel: weight' = k weight, bias' = k bias + d, computed
in float64 (Ioffe, Szegedy 2015 for the k and d of a normalization). A weight that
several layers share is scaled once for each different k, so that layers followed by the
same numbers still share it. The copies may grow the file by the price of the removed
nodes (:mod:`me2e_compress.passes.work`); if they cost more, the weight and the nodes
after its layers stay unchanged.

Factors of matrix products::

    Given:   (MatMul(x, w) + bias) * c;  Reshape(Gemm(x, w)) / c;  MatMul(x * c, w)
    Result:  MatMul(x, c w) + c bias;  Reshape(Gemm(x, w / c));  MatMul(x, c w)

Behind a layer the factor may differ by column, also where Reshape and Transpose have
split the columns into heads and coordinates: deformable attention divides its sampling
offsets [..., heads, levels, points, 2] by the width and height of a map, [2] (Zhu et
al., 2021, appendix A.2). Before a layer it is one number. Computed in float64.
"""

import hashlib
import math

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import bias_of, channel_axis, input_at, static_shape
from me2e_compress.graph.nodes import (
    Array,
    Numbers,
    array_of,
    holds_numbers,
    numbers_of,
    overflow,
    sole_reader,
)
from me2e_compress.graph.provenance import inherit
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    constant,
    either,
    fresh_name,
    match,
    moved,
    op,
    var,
)
from me2e_compress.passes.digits import Layout, before, sizes, whole
from me2e_compress.passes.work import BYTES_PER_NODE, work

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


def _fold_affine(found: Match, kit: Kit) -> str | None:
    layer, affine = found.node(LAYER), _affine(found)
    bias, what = _bias(layer), layer.op_type
    if affine is None or bias is None or not holds_numbers(found[SHARED]):
        return f"{what} whose weights are computed"
    # Compute the new weight and bias in float64
    stored, shift = found.array(SHARED), affine[1]
    scale = _per_output(layer, affine[0])
    weight = _scaled(layer, found.numbers(SHARED), scale)
    bias = np.broadcast_to(bias * scale + shift, scale.shape)
    if overflow(weight, stored) or overflow(bias, stored):
        return f"{what} whose weights would overflow"
    # Store them, unless copies of a shared weight cost too much
    name = found[SHARED].name or layer.name or "layer"
    if not _give(layer, found[SHARED], weight.astype(stored.dtype), scale, kit):
        return f"{what} that shares its weights"
    kit.refill(
        layer, 2, bias.astype(stored.dtype), f"{name.removesuffix('.weight')}.bias"
    )
    if what == "Gemm":
        layer.attributes["beta"] = ir.AttrFloat32("beta", 1.0)  # it is in the bias
    kit.absorb(layer)
    return None


def _give(
    layer: ir.Node, shared: ir.Value, weight: Array, scale: Numbers, kit: Kit
) -> bool:
    if (scale == 1).all():
        return True
    # Reuse the copy of a layer with the same scale, unless it was scaled again since
    name = _copy_name(layer, shared, scale)
    copy = kit.graph.initializers.get(name)
    tensor = None if copy is None else copy.const_value
    if tensor is None or not np.array_equal(tensor.numpy(), weight):
        copy = None
    if copy is None and sole_reader(shared) is layer:
        kit.refill(layer, 1, weight, shared.name or name)
        return True
    # Else make a copy if the removed nodes are worth it
    if copy is None:
        if not _is_worth_copies(shared):
            return False
        copy = kit.constant(weight, name)
    layer.replace_input_with(1, copy)
    return True


def _copy_name(layer: ir.Node, shared: ir.Value, scale: Numbers) -> str:
    """Name the copy of a weight after its layout and scale: equal copies are one."""
    layout = f"{layer.op_type} {layer.attributes.get_int('transB', 0)}"
    digest = hashlib.blake2b(layout.encode(), digest_size=8)
    digest.update(np.ascontiguousarray(scale).tobytes())
    return f"{shared.name}.scaled.{digest.hexdigest()}"


def _is_worth_copies(shared: ir.Value) -> bool:
    """Return whether the removed nodes are worth the copies of a shared weight."""
    copies, stays, worth = set[str](), shared.is_graph_output(), 0.0
    for layer, index in shared.uses():
        reader = sole_reader(layer.outputs[0]) if index == 1 else None
        found = affine = None
        if reader is not None and not reader.attributes.get_int("training_mode", 0):
            found = match(AFFINE, reader)
        if found is not None and found.node(LAYER) is layer:
            affine = _affine(found)
        if found is None or affine is None:
            stays = True
            continue
        worth += BYTES_PER_NODE * work(found.root)
        copies.add(_copy_name(layer, shared, _per_output(layer, affine[0])))
    made = shared.graph.initializers if shared.graph is not None else {}
    growth = sum(name not in made for name in copies) - (not stays)
    tensor = shared.const_value
    return growth * (0 if tensor is None else tensor.nbytes) <= worth


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


# Factors of a matrix product.

SOURCE = var("source", computed=True)
WEIGHT, BIAS, FACTOR = constant(), constant(), constant()
PRODUCT = op(("MatMul", "Gemm"), SOURCE, WEIGHT, more=True, shared=True)
SUM = op("Add", PRODUCT, BIAS, shared=True)
LINEAR = either(SUM, PRODUCT)
MOVED = moved(LINEAR, shared=True)
BEHIND = op(("Mul", "Div"), MOVED, FACTOR)

SCALED = op(("Mul", "Div"), SOURCE, FACTOR, shared=True)
BEFORE = op(("MatMul", "Gemm"), SCALED, WEIGHT, more=True)


def _is_behind(match: Match, facts: Facts) -> bool:
    """Return whether a factor is one number per column; a Gemm's own is affine."""
    product = match.node(PRODUCT)
    if len(match.array(WEIGHT).shape) != 2:
        return False
    if product.op_type == "Gemm" and match[MOVED] is product.outputs[0]:
        return False
    return _columns(match, product) is not None


def _is_before(match: Match, facts: Facts) -> bool:
    """Return whether a factor is one number, and a layer's rows are scaled by it."""
    numbers, source = _factor(match, match.node(SCALED)), match[SOURCE].shape
    if numbers is None or numbers.size != 1:
        return False
    is_layer = len(match.array(WEIGHT).shape) == 2
    return is_layer and numbers.ndim <= (0 if source is None else len(source))


def _factor(match: Match, node: ir.Node) -> Numbers | None:
    """Return what a node multiplies by; None if zero: a sum would lose its sign."""
    numbers = match.numbers(FACTOR)
    divides = node.op_type == "Div"
    if not numbers.all() or (divides and np.isinf(numbers).any()):
        return None
    return 1 / numbers if divides else numbers


def _columns(match: Match, product: ir.Node) -> Numbers | None:
    """Return the factor of all columns, [1], or of each, [N]; None if rows differ."""
    numbers = _factor(match, match.root)
    if numbers is None:
        return None
    value, source = match[MOVED], match[LINEAR]
    rank = len(value.shape) if value.shape is not None else 1
    if numbers.size == 1 and numbers.ndim <= rank:
        return numbers.reshape(-1)
    width = match.array(WEIGHT).shape[not product.attributes.get_int("transB", 0)]
    if value is source and numbers.shape == (width,):
        return numbers
    # It may vary only along axes that the columns alone became
    shape = static_shape(value)
    if shape is None or shape != static_shape(match.root.outputs[0]):
        return None
    layout = _layout(value, source, shape)
    if layout is None or sizes(layout)[-1] != width:
        return None
    numbers = numbers.reshape((1,) * (rank - numbers.ndim) + numbers.shape)
    varying = {str(axis) for axis, size in enumerate(numbers.shape) if size > 1}
    if any(digit.axis in varying for digits in layout[:-1] for digit in digits):
        return None
    # Look up the factor of every column
    places = [np.zeros(width, np.int64) for _ in shape]
    steps = np.unravel_index(np.arange(width), [digit.size for digit in layout[-1]])
    for digit, step in zip(layout[-1], steps, strict=True):
        if digit.axis in varying:
            places[int(digit.axis)] += step * digit.stride
    found: Numbers = numbers[tuple(places)]
    return found


def _layout(value: ir.Value, source: ir.Value, shape: tuple[int, ...]) -> Layout | None:
    """Return what the axes of a source consist of: axes of a value, by their numbers.

    Only layout operators stand between them. None if an axis is broken up.
    """
    layout: Layout = tuple(whole(str(axis), size) for axis, size in enumerate(shape))
    while value is not source:
        node = value.producer()
        earlier = None if node is None else node.inputs[0]
        back = None if node is None else before(node, layout)
        if earlier is None or back is None:
            return None
        value, layout = earlier, back
    return layout


def _readers_behind(match: Match, facts: Facts) -> str | None:
    product = match.node(PRODUCT)
    if any(sole_reader(node.outputs[0]) is None for node in match.nodes[1:]):
        return f"a factor behind a {product.op_type} that others read too"
    for what, node, index in _parts(match):
        if not _is_owned(node, index):
            return f"a factor behind a {product.op_type} that shares its {what}"
    return None


def _readers_before(match: Match, facts: Facts) -> str | None:
    what = f"a factor before a {match.root.op_type} that"
    if sole_reader(match[SCALED]) is None:
        return f"{what} others read too"
    return None if _is_owned(match.root, 1) else f"{what} shares its weight"


def _is_owned(node: ir.Node, index: int) -> bool:
    value = node.inputs[index]
    return value is not None and value.is_initializer() and sole_reader(value) is node


def _parts(match: Match) -> list[tuple[str, ir.Node, int]]:
    """List what a factor behind a layer goes into: weight, biases; node and operand."""
    product = match.node(PRODUCT)
    parts = [("weight", product, 1)]
    if input_at(product, 2) is not None:
        parts.append(("bias", product, 2))
    if SUM in match:
        total = match.node(SUM)
        parts.append(("bias", total, list(total.inputs).index(match[BIAS])))
    return parts


def _fold_behind(match: Match, kit: Kit) -> str | None:
    """Scale the columns of a layer; what moves them, if anything, makes the result."""
    product = match.node(PRODUCT)
    factor = _columns(match, product)
    assert factor is not None
    parts = _parts(match)
    reason = _scale_parts(product, parts, factor, kit)
    if reason is None:
        # what lies between holds other values now: ranges and dumps go by names
        for value in (node.outputs[0] for node in match.nodes[1:]):
            value.name = fresh_name(f"{value.name}_scaled", kit.names)
        kit.absorb(match.node(MOVED), *(node for _, node, _ in parts))
    return reason


def _fold_before(match: Match, kit: Kit) -> str | None:
    """Scale a matrix by the factor of what it multiplies, and read that unscaled."""
    product, scaled = match.root, match.node(SCALED)
    factor = _factor(match, scaled)
    assert factor is not None
    reason = _scale_parts(product, [("weight", product, 1)], factor.reshape(1), kit)
    if reason is None:
        product.replace_input_with(0, match[SOURCE])
        inherit(product, (product, scaled), by=kit.by)
    return reason


def _scale_parts(
    product: ir.Node, parts: list[tuple[str, ir.Node, int]], factor: Numbers, kit: Kit
) -> str | None:
    """Write all scaled weights and biases, or none if one would overflow."""
    made: list[Array] = []
    for what, node, index in parts:
        flips = product.attributes.get_int("transB", 0)
        stored, numbers = array_of(node.inputs[index]), numbers_of(node.inputs[index])
        assert stored is not None
        assert numbers is not None
        numbers = numbers * (factor[:, None] if flips and what == "weight" else factor)
        if overflow(numbers, stored):
            return f"a factor under which a {what} would overflow"
        made.append(numbers.astype(stored.dtype))
    for (_, node, index), array in zip(parts, made, strict=True):
        kit.refill(node, index, array, "")  # its own, so it keeps its name
    return None


FUSIONS = (
    Fusion("layers with what follows them", AFFINE, _fold_affine, where=_is_affine),
    Fusion(
        "factors behind products", BEHIND, _fold_behind, _readers_behind, _is_behind
    ),
    Fusion(
        "factors before products", BEFORE, _fold_before, _readers_before, _is_before
    ),
)
