"""Fuse decomposed layer normalization (Ba, Kiros, Hinton 2016).

Given:   d = x - ReduceMean(x);  d / Sqrt(ReduceMean(d * d) + eps) * scale + bias
Result:  LayerNormalization(x, scale, bias)
"""

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, rank_of, static_shape
from me2e_compress.graph.nodes import integers_at
from me2e_compress.graph.rewrite import (
    Facts,
    Fusion,
    Kit,
    Match,
    constant,
    either,
    op,
    scalar_of,
    sole_reader,
    var,
)

KINDS = (ir.DataType.FLOAT, ir.DataType.FLOAT16)
SINCE = 17
"""The opset that brought LayerNormalization."""

X = var("x")
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


def _check(match: Match, facts: Facts) -> str | None:
    if facts.opset < SINCE:
        return f"LayerNormalization needs opset {SINCE}"
    if static_shape(match[X]) is None or match[X].dtype not in KINDS:
        return "LayerNormalization of an unknown shape or of float64"
    return None


def _rewrite(match: Match, kit: Kit) -> None:
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


FUSION = Fusion(
    "layer normalizations", NORMALIZED, _rewrite, _check, _is_over_last_axes
)
