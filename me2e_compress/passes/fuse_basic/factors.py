"""Fold constant factors into the weights of matrix products.

Given:   (MatMul(x, w) + bias) * c;  Reshape(Gemm(x, w)) / c;  MatMul(x * c, w)

Result:  MatMul(x, c w) + c bias;  Reshape(Gemm(x, w / c));  MatMul(x, c w)

Behind a layer the factor may differ by column, also where Reshape and Transpose have
split the columns into heads and coordinates: deformable attention divides its sampling
offsets [..., heads, levels, points, 2] by the width and height of a map, [2] (Zhu et
al., 2021, appendix A.2). Before a layer it is one number. Computed in float64.
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import input_at, static_shape
from me2e_compress.graph.rewrite import (
    Array,
    Facts,
    Fusion,
    Kit,
    Match,
    Numbers,
    array_of,
    constant,
    either,
    fresh_name,
    inherit,
    moved,
    numbers_of,
    op,
    overflow,
    sole_reader,
    var,
)
from me2e_compress.passes.digits import Layout, before, sizes, whole

SOURCE = var("source", computed=True)
WEIGHT, BIAS, FACTOR = constant(), constant(), constant()
PRODUCT = op(("MatMul", "Gemm"), SOURCE, WEIGHT, more=True, shared=True)
SUM = op("Add", PRODUCT, BIAS, shared=True)
LAYER = either(SUM, PRODUCT)
MOVED = moved(LAYER, shared=True)
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
    value, source = match[MOVED], match[LAYER]
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
    reason = _scale(product, parts, factor, kit)
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
    reason = _scale(product, [("weight", product, 1)], factor.reshape(1), kit)
    if reason is None:
        product.replace_input_with(0, match[SOURCE])
        inherit(product, (product, scaled), by=kit.by)
    return reason


def _scale(
    product: ir.Node,
    parts: list[tuple[str, ir.Node, int]],
    factor: Numbers,
    kit: Kit,
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
    Fusion(
        "factors behind products", BEHIND, _fold_behind, _readers_behind, _is_behind
    ),
    Fusion(
        "factors before products", BEFORE, _fold_before, _readers_before, _is_before
    ),
)
