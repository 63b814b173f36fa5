"""Fuse what exporters decompose into ONNX's operators: activations, normalization.

Given:   x * 0.5 * (1 + Erf(x / sqrt 2));
         d = x - ReduceMean(x);  d / Sqrt(ReduceMean(d * d) + eps) * scale + bias
Result:  Gelu(x);  LayerNormalization(x, scale, bias)

Gelu: Hendrycks, Gimpel 2016 (erf and tanh forms). LayerNormalization: Ba, Kiros, Hinton
2016.
"""

import math
from collections.abc import Mapping

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rank_of, static_shape
from me2e_compress.graph.nodes import (
    integers_at,
    scalar_of,
    sole_reader,
)
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    Pattern,
    constant,
    either,
    needs_opset,
    op,
    product,
    var,
)

SINCE = {"Gelu": 20, "LayerNormalization": 17}
"""The opset that brought each operator."""

TANH_CUBE = 0.044715
"""The cubic term of the tanh form of Gelu."""

TANH_ROOT = math.sqrt(2 / math.pi)
"""The factor before the bracket of that form."""

KINDS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)

X = var("x")
ONE = constant(1.0)

ERF = op("Erf", product(X, scale=1 / math.sqrt(2)))
TANH = op(
    "Tanh",
    either(
        product(op("Add", X, product(X, X, X, scale=TANH_CUBE)), scale=TANH_ROOT),
        product(X, op("Add", product(X, X, scale=TANH_CUBE), ONE), scale=TANH_ROOT),
    ),
)


def _gelu(pattern: Pattern, attributes: Mapping[str, str] | None = None) -> Fusion:
    def put(match: Match, kit: Kit) -> None:
        kit.put("Gelu", [match[X]], attributes)

    check = needs_opset("Gelu", SINCE["Gelu"])
    return Fusion("activations", pattern, put, check, _is_float)


def _is_float(match: Match, facts: Facts) -> bool:
    """Return whether it is of floats, and no constant has more axes than x."""
    rank, made = rank_of(match[X]), match.root.outputs[0]
    return made.dtype in KINDS and rank is not None and rank == rank_of(made)


GELUS = (
    _gelu(product(X, op("Add", ERF, ONE), scale=0.5)),
    _gelu(product(X, op("Add", TANH, ONE), scale=0.5), {"approximate": "tanh"}),
)


# Layer normalization.

EPSILON = constant(scalar=True)
# exporters write x - mean once or twice, and others may read either
MEANS = tuple(op("ReduceMean", X, more=True, shared=True) for _ in range(2))
CENTRED, AGAIN = (op("Sub", X, mean, shared=True) for mean in MEANS)
SQUARE = either(
    op("Mul", AGAIN, AGAIN),
    op("Pow", AGAIN, constant(), where=lambda node: scalar_of(node.inputs[1]) == 2.0),
)
VARIANCE = op("ReduceMean", SQUARE, more=True)
NORMALIZED = op("Div", CENTRED, op("Sqrt", op("Add", VARIANCE, EPSILON)))


def _is_over_last_axes(match: Match, facts: Facts) -> bool:
    """Return whether all three means are over the same last axes."""
    rank = rank_of(match[X]) or 0
    first, *others = [_axes(match.node(mean)) for mean in (VARIANCE, *MEANS)]
    if not rank or not first or others != [first, first]:
        return False
    if rank_of(match.root.outputs[0]) != rank:
        return False  # the epsilon has more axes
    # The axes must be the last ones
    last = list(range(rank - len(first), rank))
    return sorted(axis % rank for axis in first) == last


def _axes(node: ir.Node) -> list[int] | None:
    if not node.attributes.get_int("keepdims", 1):
        return None
    return integers_at(node, "axes", 1)


def _check_normal(match: Match, facts: Facts) -> str | None:
    since = SINCE["LayerNormalization"]
    if facts.opset < since:
        return f"LayerNormalization needs opset {since}"
    if static_shape(match[X]) is None or match[X].dtype not in KINDS:
        return "LayerNormalization of an unknown shape or of float64"
    return None


def _put_normal(match: Match, kit: Kit) -> None:
    source, root = match[X], match.root
    shape, axes = static_shape(source) or (), _axes(match.node(VARIANCE)) or []
    normal = shape[len(shape) - len(axes) :]
    # Take in the scale and bias that follow
    multiplied, scale = _following(root, "Mul", normal)
    end = root if multiplied is None else multiplied
    added, bias = _following(end, "Add", normal)
    epsilon = match.array(EPSILON)
    if scale is None:
        ones = np.ones(normal, epsilon.dtype)
        scale = kit.constant(ones, f"{root.outputs[0].name}_scale")
    kit.put(
        "LayerNormalization",
        [source, scale, *([] if bias is None else [bias])],
        {"axis": -len(axes), "epsilon": float(epsilon.item())},
        behind=[node for node in (multiplied, added) if node is not None],
    )


def _following(
    node: ir.Node, op_type: str, shape: tuple[int, ...]
) -> tuple[ir.Node | None, ir.Value | None]:
    """Return the Mul (or Add) that scales (or shifts) a result, and its constant."""
    reader = sole_reader(node.outputs[0])
    if reader is None or reader.op_type != op_type or reader.graph is not node.graph:
        return None, None
    for value in reader.inputs:
        array = array_of(value)
        if array is not None and array.shape == shape:
            return reader, value
    return None, None


LAYER_NORM = Fusion(
    "layer normalizations", NORMALIZED, _put_normal, _check_normal, _is_over_last_axes
)
