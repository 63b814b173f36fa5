"""If, Loop and Scan whose bodies read what is around them, and functions."""

from collections.abc import Callable

import numpy as np
import onnx
from onnx import helper

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import BOOL, INT64, Builder, Val, is_static
from tests.fuzz.exact.motifs import layers, oddities, rows

INNER: tuple[Callable[[Builder], None], ...] = (
    layers.one_layer, layers.layers_in_a_row, layers.same_source, rows.repeated_rows,
    layers.constant_chain, layers.swish, layers.gelu, layers.layer_norm,
    oddities.no_ops, oddities.pairs, oddities.twins, rows.computed_reshape,
)  # fmt: skip
"""Motifs that a body may have: none that must make an input."""


def _body(b: Builder, x: Val, *, steps: int = 1) -> tuple[Builder, Val]:
    """Draw a body that starts from a value and gives one of the same shape."""
    body = b.inner()
    body.outer = tuple(each for each in body.outer if _is_plain(each)) or (x,)
    if x not in body.outer:
        body.outer = (*body.outer, x)
    y = x
    for _ in range(steps):
        if not (b.chance(0.6) and _is_plain(x)):
            (branch if b.chance(0.1) else b.rng.choice(INNER))(body)
        y = _same_shape(body, y)
    return body, y


def _is_plain(x: Val) -> bool:
    return 2 <= x.rank <= 4 and x.is_rows(2)


def _same_shape(b: Builder, x: Val) -> Val:
    """Do something that keeps the shape: a square layer, a factor, an activation."""
    kind = b.rng.random()
    if kind < 0.4 and _is_plain(x):
        return layers.layer(b, x, x.width)
    if kind < 0.6:
        return sp.binary(b, b.rng.choice(("Add", "Mul", "Sub")), x, rows.operand(b, x))
    if kind < 0.7:
        return sp.softmax(b, x, -1)
    return sp.unary(b, x)


def condition(b: Builder) -> Val:
    """A condition that is fed, constant, or a comparison of constants."""
    kind = b.rng.random()
    if kind < 0.5:
        return b.input((), BOOL)
    if kind < 0.8:
        return b.const(np.asarray(b.chance(0.5)))
    pair = [b.const(np.asarray(b.rng.randint(0, 1), np.int64)) for _ in range(2)]
    return b.op("Equal", pair, (), dtype=BOOL)


def branch(b: Builder) -> None:
    """An If; a branch may hand on a value from outside as it is, by an Identity."""
    x = b.rows(2, 4)
    chosen = condition(b)
    graphs = {}
    twin = b.chance(0.15)
    for name in ("then_branch", "else_branch"):
        body, y = _body(b, x, steps=b.rng.randint(1, 2))
        if y is x or b.chance(0.1):
            y = body.op("Identity", [x], x.shape)
        outputs = [y]
        if twin:
            outputs.append(body.op("Identity", [y], y.shape))
        graphs[name] = body.graph(outputs, b.fresh("body"))
    results = [Val(b.fresh("v"), x.shape, x.dtype) for _ in range(2 if twin else 1)]
    b.emit("If", [chosen], results, graphs)
    sp.at_times(b, 0.5, results[0])


def loop(b: Builder) -> None:
    """A Loop that carries a value, and collects another at times."""
    x = b.rows(2, 3)
    if not is_static(x.shape):
        x = b.input((b.rng.randint(1, 4), 8))
    count = b.rng.randint(1, 3)
    body = b.inner()
    body.outer = tuple(each for each in body.outer if _is_plain(each))
    step = Val(b.fresh("step"), (), INT64)
    go = Val(b.fresh("go"), (), BOOL)
    carried = Val(b.fresh("carried"), x.shape, x.dtype)
    body.inputs += [step, go, carried]
    body.values.append(carried)
    y = _same_shape(body, carried)
    if b.chance(0.5):
        y = _same_shape(body, y)
    y = body.op("Tanh", [y], y.shape)
    outputs = [body.op("Identity", [go], (), dtype=BOOL), y]
    results = [Val(b.fresh("v"), x.shape, x.dtype)]
    if b.chance(0.4):
        outputs.append(sp.unary(body, y))
        results.append(Val(b.fresh("v"), (count, *x.shape), x.dtype))
    graph = body.graph(outputs, b.fresh("body"))
    trips = b.const(np.asarray(count, np.int64))
    keep = b.const(np.asarray(True)) if b.chance(0.7) else None
    b.emit("Loop", [trips, keep, x], results, {"body": graph})


def called(b: Builder) -> None:
    """A function of the model, called once or twice."""
    x = b.rows(2, 3)
    name = b.fresh("Block")
    inner = Builder(b.shared)
    parameter = Val("given", x.shape, x.dtype)
    weight = Val("matrix", (x.width, x.width), x.dtype)
    y = inner.op("MatMul", [parameter, weight], x.shape)
    for _ in range(b.rng.randint(1, 3)):
        y = sp.unary(inner, y)
    if b.chance(0.4):
        y = inner.op("Add", [y, parameter], x.shape)
    if b.chance(0.3):
        y = inner.op("Identity", [y], x.shape)
    imports = [helper.make_opsetid("", b.opset)]
    function: onnx.FunctionProto = helper.make_function(
        "blocks", name, ["given", "matrix"], [y.name], inner.nodes, imports
    )
    b.shared.functions.append(function)
    for _ in range(b.rng.randint(1, 2)):
        matrix = b.weight((x.width, x.width))
        x = b.op(name, [x, matrix], x.shape, domain="blocks")
