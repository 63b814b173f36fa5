"""Gradients of what works element by element, of sums and normalizations."""

import math
from collections.abc import Callable, Mapping, Sequence
from typing import TypeAlias

import numpy as np
import onnx_ir as ir

from me2e_compress.graph import array_of
from me2e_compress.graph.nodes import input_at, integers_at, integers_of
from me2e_compress.sensitivity.gradients.tape import (
    Found,
    NoRuleError,
    Rule,
    Tape,
    given,
    numpy_of,
    sizes_of,
)

Slope: TypeAlias = Callable[[Tape, ir.Value, ir.Value], ir.Value]
"""Writes the slope at x, where an operator gives y."""


def _bell(t: Tape, x: ir.Value, scale: float, width: float) -> ir.Value:
    """Return scale * exp(-width * x^2)."""
    power = t.times(x, x, t.number(-width, x))
    return t.times(t.op("Exp", [power]), t.number(scale, x))


def _erf(t: Tape, x: ir.Value, y: ir.Value) -> ir.Value:
    return _bell(t, x, 2 / math.sqrt(math.pi), 1)


def _gelu(t: Tape, x: ir.Value, y: ir.Value) -> ir.Value:
    half = t.number(0.5, x)
    erf = t.op("Erf", [t.times(x, t.number(math.sqrt(0.5), x))])
    below = t.op("Add", [half, t.times(half, erf)])
    density = _bell(t, x, 1 / math.sqrt(2 * math.pi), 0.5)
    return t.op("Add", [below, t.times(x, density)])


def _same(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    return [g]


def _relu(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y = node.outputs[0]
    return [t.only(t.op("Greater", [y, t.number(0, y)]), g, y)]


def _leaky_relu(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, slope = node.outputs[0], node.attributes.get_float("alpha", 0.01)
    above = t.op("Greater", [y, t.number(0, y)])
    return [t.op("Where", [above, g, t.times(g, t.number(slope, y))])]


def _clip(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y = node.outputs[0]
    return [t.only(t.op("Equal", [node.inputs[0], y]), g, y)]


def _cast(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    kind = given(node.inputs[0]).dtype or ir.DataType.FLOAT
    return [t.op("Cast", [g], {"to": kind.value})]


def _add(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    return [t.narrowed(g, node.outputs[0], given(each)) for each in node.inputs]


def _sub(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (a, b) = node.outputs[0], map(given, node.inputs)
    return [t.narrowed(g, y, a), t.narrowed(t.op("Neg", [g]), y, b)]


def _mul(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (a, b) = node.outputs[0], map(given, node.inputs)
    g = _unexpanded(g, y, (a, b))
    return [t.narrowed(t.times(g, b), y, a), t.narrowed(t.times(g, a), y, b)]


def _unexpanded(g: ir.Value, y: ir.Value, factors: Sequence[ir.Value]) -> ir.Value:
    """Return a sum's gradient before it was expanded, if either product expands it."""
    expand = g.producer()
    if expand is None or expand.op_type != "Expand":
        return g
    before = given(expand.inputs[0])
    shaped = before.producer()
    sizes = None if shaped is None else integers_of(input_at(shaped, 1))
    if sizes is None or shaped is None or shaped.op_type != "Reshape":
        return g
    made = {np.broadcast_shapes(sizes, sizes_of(each)) for each in factors}
    return before if made == {sizes_of(y)} else g


def _div(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (a, b) = node.outputs[0], map(given, node.inputs)
    each = t.op("Div", [g, b])
    below = t.op("Neg", [t.times(each, y)])
    return [t.narrowed(each, y, a), t.narrowed(below, y, b)]


def _pow(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (a, b) = node.outputs[0], map(given, node.inputs)
    power = array_of(b)
    if power is None or power.size != 1:
        raise NoRuleError("its exponent is not a constant")
    less = t.op("Pow", [a, t.number(float(power.item()) - 1, a)])
    return [t.narrowed(t.times(g, t.number(float(power.item()), a), less), y, a)]


def _extreme(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    """Share a gradient between those that are the extreme."""
    y = node.outputs[0]
    equal = [t.as_number(t.op("Equal", [each, y]), y) for each in node.inputs]
    part = t.op("Div", [g, t.op("Sum", equal)])
    return [
        t.narrowed(t.times(part, mine), y, given(each))
        for mine, each in zip(equal, node.inputs, strict=True)
    ]


def _mod(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    return [t.narrowed(g, node.outputs[0], given(node.inputs[0]))]


def _where(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, (choice, a, b) = node.outputs[0], map(given, node.inputs)
    other = t.op("Where", [choice, t.number(0, y), g])
    return [None, t.narrowed(t.only(choice, g, y), y, a), t.narrowed(other, y, b)]


def _spread(
    t: Tape, node: ir.Node, g: ir.Value
) -> tuple[ir.Value, list[int], list[int]]:
    """Return a gradient with the reduced axes as ones, that shape, and these axes."""
    x, axes = sizes_of(node.inputs[0]), integers_at(node, "axes", 1)
    if axes is None and input_at(node, 1) is not None:
        raise NoRuleError("its axes are not constant")
    if not axes:
        idle = node.attributes.get_int("noop_with_empty_axes", 0)
        axes = [] if idle else [*range(len(x))]
    gone = sorted(at % len(x) for at in axes)
    kept = [1 if at in gone else size for at, size in enumerate(x)]
    return t.shaped(g, kept), kept, gone


def _reduce_sum(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    kept, _, _ = _spread(t, node, g)
    return [t.op("Expand", [kept, t.ints(sizes_of(node.inputs[0]))])]


def _reduce_mean(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    kept, _, axes = _spread(t, node, g)
    sizes = sizes_of(node.inputs[0])
    count = math.prod(sizes[at] for at in axes)
    part = t.times(kept, t.number(1 / count, node.inputs[0]))
    return [t.op("Expand", [part, t.ints(sizes)])]


def _reduce_extreme(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    """Share a gradient between those that are the extreme, as equal points are."""
    kept, shape, axes = _spread(t, node, g)
    x, y = given(node.inputs[0]), t.shaped(node.outputs[0], shape)
    equal = t.as_number(t.op("Equal", [x, y]), x)
    return [t.times(equal, t.op("Div", [kept, t.total(equal, axes, keep=True)]))]


def _reduce_l2(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    kept, shape, _ = _spread(t, node, g)
    part = t.op("Div", [kept, t.shaped(node.outputs[0], shape)])
    return [t.times(given(node.inputs[0]), part)]


def _cum_sum(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    reverse = 1 - node.attributes.get_int("reverse", 0)
    exclusive = node.attributes.get_int("exclusive", 0)
    options = {"reverse": reverse, "exclusive": exclusive}
    return [t.op("CumSum", [g, node.inputs[1]], options)]


def _softmax(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    y, axis = node.outputs[0], node.attributes.get_int("axis", -1)
    weighted = t.times(g, y)
    total = t.total(weighted, [axis], keep=True)
    return [t.op("Sub", [weighted, t.times(y, total)])]


def _log_softmax(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    axis = node.attributes.get_int("axis", -1)
    total = t.total(g, [axis], keep=True)
    return [t.op("Sub", [g, t.times(t.op("Exp", [node.outputs[0]]), total)])]


def _layer_norm(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, scale = given(node.inputs[0]), given(node.inputs[1])
    options, sizes = node.attributes, sizes_of(x)
    first = options.get_int("axis", -1) % len(sizes)
    ones = t.constant(np.ones(sizes[first:], numpy_of(x)))
    # without scale and bias, the operator gives what is needed: n and r
    rate = t.op("LayerNormalization", [x, ones], options, outputs=3)
    made = rate.producer()
    n, rate = rate if made is None else made.outputs[0], t.as_number(rate, x)
    return [_normalized(t, x, n, rate, t.times(g, scale), range(first, len(sizes)))]


def _instance_norm(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, scale = given(node.inputs[0]), given(node.inputs[1])
    rank = len(sizes_of(x))
    scale = t.shaped(scale, [-1] + [1] * (rank - 2))
    epsilon = t.number(node.attributes.get_float("epsilon", 1e-5), x)
    centred = t.op("Sub", [x, _mean(t, x, range(2, rank), x)])
    spread = _mean(t, t.times(centred, centred), range(2, rank), x)
    rate = t.op("Reciprocal", [t.op("Sqrt", [t.op("Add", [spread, epsilon])])])
    n = t.times(centred, rate)
    return [_normalized(t, x, n, rate, t.times(g, scale), range(2, rank))]


def _normalized(
    t: Tape,
    x: ir.Value,
    n: ir.Value,
    rate: ir.Value,
    g: ir.Value,
    axes: Sequence[int],
) -> ir.Value:
    """Return r (g - mean(g) - n mean(g n)) of n = r (x - mean(x))."""
    turned = t.times(n, _mean(t, t.times(g, n), axes, x))
    left = t.op("Sub", [g, _mean(t, g, axes, x)])
    return t.times(rate, t.op("Sub", [left, turned]))


def _mean(t: Tape, value: ir.Value, axes: Sequence[int], like: ir.Value) -> ir.Value:
    each = t.number(1 / math.prod(sizes_of(like)[at] for at in axes), like)
    return t.times(t.total(value, list(axes), keep=True), each)


def _batch_norm(t: Tape, node: ir.Node, g: ir.Value) -> Found:
    x, scale, _, _, variance = map(given, node.inputs)
    epsilon = t.number(node.attributes.get_float("epsilon", 1e-5), variance)
    spread = t.op("Sqrt", [t.op("Add", [variance, epsilon])])
    factor = t.op("Div", [scale, spread])
    return [t.times(g, t.shaped(factor, [-1] + [1] * (len(sizes_of(x)) - 2)))]


SLOPES: Mapping[str, Slope] = {
    "Abs": lambda t, x, y: t.op("Sign", [x]),
    "Cos": lambda t, x, y: t.op("Neg", [t.op("Sin", [x])]),
    "Erf": _erf,
    "Exp": lambda t, x, y: y,
    "Gelu": _gelu,
    "Log": lambda t, x, y: t.op("Reciprocal", [x]),
    "Neg": lambda t, x, y: t.number(-1, x),
    "Reciprocal": lambda t, x, y: t.op("Neg", [t.times(y, y)]),
    "Sigmoid": lambda t, x, y: t.op("Sub", [y, t.times(y, y)]),
    "Sin": lambda t, x, y: t.op("Cos", [x]),
    "Softplus": lambda t, x, y: t.op("Sigmoid", [x]),
    "Sqrt": lambda t, x, y: t.op("Div", [t.number(0.5, x), y]),
    "Tanh": lambda t, x, y: t.op("Sub", [t.number(1, x), t.times(y, y)]),
}


def _of_slope(slope: Slope) -> Rule:
    def rule(t: Tape, node: ir.Node, g: ir.Value) -> Found:
        return [t.times(g, slope(t, given(node.inputs[0]), node.outputs[0]))]

    return rule


RULES: Mapping[str, Rule] = {
    "Identity": _same,
    "Relu": _relu,
    "LeakyRelu": _leaky_relu,
    "Clip": _clip,
    "Cast": _cast,
    "Add": _add,
    "Sum": _add,
    "Sub": _sub,
    "Mul": _mul,
    "Div": _div,
    "Pow": _pow,
    "Max": _extreme,
    "Min": _extreme,
    "Mod": _mod,
    "Where": _where,
    "ReduceSum": _reduce_sum,
    "ReduceMean": _reduce_mean,
    "ReduceMax": _reduce_extreme,
    "ReduceMin": _reduce_extreme,
    "ReduceL2": _reduce_l2,
    "CumSum": _cum_sum,
    "Softmax": _softmax,
    "LogSoftmax": _log_softmax,
    "LayerNormalization": _layer_norm,
    "InstanceNormalization": _instance_norm,
    "BatchNormalization": _batch_norm,
    **{name: _of_slope(slope) for name, slope in SLOPES.items()},
}
