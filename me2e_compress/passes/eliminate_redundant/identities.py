"""Find nodes that return their input unchanged.

Each rule returns the value that a node's first output equals, bit for bit, or None.
Adding +0.0 is not an identity (-0.0 + 0.0 is +0.0); adding -0.0 is, and so is
subtracting +0.0.
"""

import functools
from collections.abc import Callable

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of, static_shape
from me2e_compress.graph.nodes import (
    input_at,
    integers_at,
    integers_of,
    maker,
    permutation_of,
)
from me2e_compress.graph.rewrite import Array, is_read, is_standard

Rule = Callable[[ir.Node, int], ir.Value | None]

OLDEST_OPSET = 7
"""Broadcasting, Dropout and BatchNormalization followed other rules before."""


def identity_of(node: ir.Node, opset: int) -> ir.Value | None:
    """Return the value that a node only repeats; None if it does something."""
    if not is_standard(node) or opset < OLDEST_OPSET or not node.outputs:
        return None
    rule = RULES.get(node.op_type)
    if rule is None or any(is_read(value) for value in node.outputs[1:]):
        return None
    return rule(node, opset)


def same_shape(one: ir.Value | None, other: ir.Value | None) -> bool:
    """Return whether two values certainly have the same shape."""
    shape = static_shape(one)
    return shape is not None and shape == static_shape(other)


def _always(node: ir.Node, opset: int) -> ir.Value | None:
    return node.inputs[0]


def _if_same_shape(node: ir.Node, opset: int) -> ir.Value | None:
    return node.inputs[0] if same_shape(node.inputs[0], node.outputs[0]) else None


def _if_alone(node: ir.Node, opset: int) -> ir.Value | None:
    return node.inputs[0] if len(node.inputs) == 1 else None


def _split(node: ir.Node, opset: int) -> ir.Value | None:
    return node.inputs[0] if len(node.outputs) == 1 else None


def _dropout(node: ir.Node, opset: int) -> ir.Value | None:
    if len(node.inputs) < 3 or node.inputs[2] is None:
        return node.inputs[0]
    training = array_of(node.inputs[2])
    return node.inputs[0] if training is not None and not training.any() else None


def _cast(node: ir.Node, opset: int) -> ir.Value | None:
    source = node.inputs[0]
    if source is None or source.dtype is None:
        return None
    return source if source.dtype == node.attributes.get_int("to", 0) else None


def _cast_like(node: ir.Node, opset: int) -> ir.Value | None:
    source, like = node.inputs
    if source is None or like is None or source.dtype is None:
        return None
    return source if source.dtype == like.dtype else None


def _transpose(node: ir.Node, opset: int) -> ir.Value | None:
    order = permutation_of(node)
    if order is not None and order == sorted(order):
        return node.inputs[0]
    if moves_nothing(node) and same_shape(node.inputs[0], node.outputs[0]):
        return node.inputs[0]
    return None


def moves_nothing(node: ir.Node) -> bool:
    """Return whether a Transpose only moves axes of size 1, as a Reshape would."""
    shape, order = static_shape(node.inputs[0]), permutation_of(node)
    if shape is None or order is None:
        return False
    real = [axis for axis in order if shape[axis] != 1]
    return real == sorted(real)


def _slice(node: ir.Node, opset: int) -> ir.Value | None:
    if input_at(node, 4) is not None:
        steps = integers_of(input_at(node, 4))
        if steps is None or any(step != 1 for step in steps):
            return None
    return _if_same_shape(node, opset) or _sliced_part(node)


def _sliced_part(node: ir.Node) -> ir.Value | None:
    """Return the operand of a Concat that a Slice takes out again, if it is one."""
    inner, shape = maker(node.inputs[0], "Concat"), static_shape(node.inputs[0])
    starts, ends = integers_at(node, "starts", 1), integers_at(node, "ends", 2)
    axes = integers_at(node, "axes", 3)
    if inner is None or shape is None or not starts or not ends:
        return None
    if axes is None or len(axes) != 1:
        return None
    axis = axes[0] % len(shape)
    if inner.attributes.get_int("axis", 0) % len(shape) != axis:
        return None
    first, last, _ = slice(starts[0], ends[0]).indices(shape[axis])
    at = 0
    for part in inner.inputs:
        sizes = static_shape(part)
        if sizes is None or at > first:
            return None
        if (at, at + sizes[axis]) == (first, last):
            return part
        at += sizes[axis]
    return None


def _pad(node: ir.Node, opset: int) -> ir.Value | None:
    pads = integers_at(node, "pads", 1)
    return node.inputs[0] if pads is not None and not any(pads) else None


def _clip(node: ir.Node, opset: int) -> ir.Value | None:
    inner = _repeats(node, opset)
    if inner is not None or opset < 11:
        return inner
    return None if any(node.inputs[1:]) else node.inputs[0]


def _repeats(node: ir.Node, opset: int) -> ir.Value | None:
    """Relu of Relu, Abs of Abs, ...: idempotent operators."""
    inner = maker(node.inputs[0], node.op_type)
    if inner is None or tuple(inner.inputs[1:]) != tuple(node.inputs[1:]):
        return None
    return node.inputs[0] if _attributes(inner) == _attributes(node) else None


def _attributes(node: ir.Node) -> list[tuple[str, object]]:
    return sorted((name, attr.value) for name, attr in node.attributes.items())


def _undoes(node: ir.Node, opset: int) -> ir.Value | None:
    """Not of Not, Neg of Neg: self-inverse operators."""
    inner = maker(node.inputs[0], node.op_type)
    return None if inner is None else inner.inputs[0]


def _neutral(test: Callable[[Array], bool], *, either: bool) -> Rule:

    def rule(node: ir.Node, opset: int) -> ir.Value | None:
        # Either operand may be the neutral one if the operator commutes
        for kept, other in ((0, 1), (1, 0))[: 2 if either else 1]:
            array = array_of(node.inputs[other])
            source = node.inputs[kept]
            if array is None or source is None or not array.size or not test(array):
                continue
            if source.dtype == node.outputs[0].dtype and _spreads(source, array, node):
                return source
        return None

    return rule


def _spreads(source: ir.Value, array: Array, node: ir.Node) -> bool:
    """Return whether broadcasting the array keeps the other operand's shape."""
    if same_shape(source, node.outputs[0]):
        return True
    return (
        array.size == 1 and source.shape is not None and array.ndim <= len(source.shape)
    )


def _zero(array: Array, *, negative: bool) -> bool:
    """Return whether all numbers are zero, those with a sign of zero of this one."""
    if array.dtype.kind in "iu":
        return not array.any()
    zero = array.dtype.kind == "f" and not array.any()
    return zero and bool(np.all(np.signbit(array) == negative))


def _one(array: Array) -> bool:
    return array.dtype.kind in "iuf" and bool(np.all(array == 1))


def _where(node: ir.Node, opset: int) -> ir.Value | None:
    if node.inputs[1] is node.inputs[2] and same_shape(node.inputs[1], node.outputs[0]):
        return node.inputs[1]
    chosen = array_of(node.inputs[0])
    if chosen is None or not chosen.size:
        return None
    if chosen.all() and same_shape(node.inputs[1], node.outputs[0]):
        return node.inputs[1]
    if not chosen.any() and same_shape(node.inputs[2], node.outputs[0]):
        return node.inputs[2]
    return None


RULES: dict[str, Rule] = {
    **dict.fromkeys(("Abs", "Ceil", "Floor", "Relu", "Round", "Sign"), _repeats),
    **dict.fromkeys(("Concat", "Max", "Mean", "Min", "Sum"), _if_alone),
    **dict.fromkeys(("Expand", "Flatten", "Reshape", "Squeeze"), _if_same_shape),
    **dict.fromkeys(("Tile", "Unsqueeze"), _if_same_shape),
    **dict.fromkeys(("Neg", "Not"), _undoes),
    **dict.fromkeys(("Div", "Pow"), _neutral(_one, either=False)),
    "Add": _neutral(functools.partial(_zero, negative=True), either=True),
    "And": _neutral(lambda array: bool(array.all()), either=True),
    "Cast": _cast,
    "CastLike": _cast_like,
    "Clip": _clip,
    "Dropout": _dropout,
    "Identity": _always,
    "Mul": _neutral(_one, either=True),
    "Or": _neutral(lambda array: not array.any(), either=True),
    "Pad": _pad,
    "Slice": _slice,
    "Split": _split,
    "Sub": _neutral(functools.partial(_zero, negative=False), either=False),
    "Transpose": _transpose,
    "Where": _where,
}
