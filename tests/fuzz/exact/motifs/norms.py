"""Normalisations and activations, decomposed as exporters write them."""

import math

import numpy as np

from tests.fuzz.exact import spelling as sp
from tests.fuzz.exact.builder import Builder
from tests.fuzz.exact.values import Val


def _square(b: Builder, x: Val) -> Val:
    if b.chance(0.7):
        two = b.const(np.asarray(2, b.rng.choice((b.dtype, b.dtype, np.int64))))
        if two.dtype == b.dtype or b.opset >= 12:
            return b.op("Pow", [x, two], x.shape)
    return sp.binary(b, "Mul", x, x)


def layer_norm(b: Builder) -> None:
    """Mean, difference, variance, root, division, gamma and beta."""
    x = b.rows(2, 4)
    axis = -1 if b.chance(0.85) else b.rng.randint(0, x.rank - 1)
    mean = sp.reduce(b, "ReduceMean", x, [axis], keep=True)
    off = sp.binary(b, "Sub", x, mean)
    other = off if b.chance(0.7) else sp.binary(b, "Sub", x, mean)
    variance = sp.reduce(b, "ReduceMean", _square(b, off), [axis], keep=True)
    made = _rooted(b, other, variance)
    if b.chance(0.85):
        made = _scaled(b, made, "Mul")
        if b.chance(0.8):
            _scaled(b, made, "Add")


def _rooted(b: Builder, x: Val, variance: Val) -> Val:
    epsilon = sp.scalar(b, b.rng.choice((1e-5, 1e-3, 1e-1)))
    if epsilon.rank > variance.rank:
        epsilon = sp.scalar(b, 1e-4, 0)
    total = sp.either_way(b, "Add", variance, epsilon)
    root = b.op("Sqrt", [total], variance.shape)
    way = b.rng.random()
    if way < 0.6:
        return sp.binary(b, "Div", x, root)
    if way < 0.8:
        return sp.binary(b, "Mul", x, b.op("Reciprocal", [root], root.shape))
    inverse = sp.binary(b, "Div", sp.scalar(b, 1.0, 0), root)
    return sp.binary(b, "Mul", x, inverse)


def _scaled(b: Builder, x: Val, kind: str) -> Val:
    shape = b.rng.choice([(x.width,)] * 5 + [(1, x.width), ()])
    gamma = b.weight(shape, 0.7)
    return sp.either_way(b, kind, x, gamma)


def gelu(b: Builder) -> None:
    """The erf or the tanh form, its factors in any order."""
    x = b.rows(1, 4)
    if b.chance(0.5) and not b.is_double:
        root = sp.scalar(b, math.sqrt(2), 0)
        inner = sp.binary(b, "Div", x, root)
        if b.chance(0.3):
            inner = sp.binary(b, "Mul", x, sp.scalar(b, 1 / math.sqrt(2), 0))
        wave = b.op("Erf", [inner], x.shape)
    else:
        cube = b.op("Pow", [x, sp.scalar(b, 3.0, 0)], x.shape)
        small = sp.binary(b, "Mul", cube, sp.scalar(b, 0.044715, 0))
        both = sp.binary(b, "Add", x, small)
        scale = sp.scalar(b, math.sqrt(2 / math.pi), 0)
        wave = b.op("Tanh", [sp.binary(b, "Mul", both, scale)], x.shape)
    bracket = sp.binary(b, "Add", wave, sp.scalar(b, 1.0, 0))
    half = sp.scalar(b, b.rng.choice((0.5, 0.5, 0.5, 0.25)), 0)
    if b.chance(0.5):
        sp.binary(b, "Mul", sp.binary(b, "Mul", x, bracket), half)
    else:
        sp.binary(b, "Mul", sp.binary(b, "Mul", x, half), bracket)


def swish(b: Builder) -> None:
    x = b.rows(1, 4)
    gate = b.op("Sigmoid", [x], x.shape)
    sp.either_way(b, "Mul", x, gate)


def hard_swish(b: Builder) -> None:
    """x * clip(x + 3, 0, 6) / 6, or by HardSigmoid."""
    x = b.rows(1, 4)
    if not b.is_double and b.chance(0.3):
        attributes = {"alpha": 1 / 6, "beta": 0.5} if b.chance(0.7) else {}
        gate = b.op("HardSigmoid", [x], x.shape, attributes)
        sp.binary(b, "Mul", x, gate)
        return
    moved = sp.binary(b, "Add", x, sp.scalar(b, 3.0))
    gate = sp.clip(b, moved, 0.0, b.rng.choice((6.0, 6.0, 6.0, None)))
    six = sp.scalar(b, 6.0)
    if b.chance(0.5):
        sp.binary(b, "Mul", x, sp.binary(b, "Div", gate, six))
    else:
        sp.binary(b, "Div", sp.binary(b, "Mul", x, gate), six)


def mish(b: Builder) -> None:
    """x * tanh(softplus(x)), the softplus in one or in three operators."""
    x = b.rows(1, 4)
    if b.chance(0.5) and not b.is_double:
        plus = b.op("Softplus", [x], x.shape)
    else:
        low = sp.clip(b, x, None, 20.0) if b.chance(0.5) else x
        plus = b.op("Exp", [low], x.shape)
        one = sp.binary(b, "Add", plus, sp.scalar(b, 1.0, 0))
        plus = b.op("Log", [one], x.shape)
    wave = b.op("Tanh", [plus], x.shape)
    sp.either_way(b, "Mul", x, wave)


def constant_chain(b: Builder) -> None:
    """Add, subtract, multiply and divide by constants in a row."""
    x = b.rows(1, 4)
    for _ in range(b.rng.randint(2, 4)):
        kind = b.rng.choice(("Add", "Sub", "Mul", "Div", "Mul", "Add", "Max", "Min"))
        number = b.rng.choice((2.0, 0.5, -3.0, 0.1, 1.0, -1.0, 0.0, -0.0, 1e-3))
        if kind == "Div" and number == 0:
            number = 4.0
        other = sp.scalar(b, number)
        if b.chance(0.4):
            other = b.const(b.uniform(0.5, 2, (x.width,)))
        if other.rank > x.rank:
            continue
        x = sp.either_way(b, kind, x, other)
