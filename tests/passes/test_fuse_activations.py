"""Activations that are written out become one operator, where the opset has one."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, fuse_basic, ops, opset, read


def body(*lines: str) -> str:
    return "g (float[3,7] x) => (float[3,7] y) {" + " ".join(lines) + "}"


HALF, UNIT = np.float32(0.5), np.float32(1)
ROOT = np.float32(np.sqrt(2))
TANH = {"k": np.float32(0.044715), "r": np.float32(np.sqrt(2 / np.pi))}
BOUNDS = {"zero": np.float32(0), "six": np.float32(6), "three": np.float32(3)}
ACTIVATIONS: list[tuple[int, str, dict[str, Any], list[str]]] = [
    (
        20,
        body("a = Div(x, r) b = Erf(a) c = Add(b, u) d = Mul(x, c) y = Mul(d, h)"),
        {"r": ROOT, "u": UNIT, "h": HALF},
        ["Gelu"],
    ),
    (
        20,
        body("a = Mul(x, r) b = Erf(a) c = Add(u, b) d = Mul(x, h) y = Mul(d, c)"),
        {"r": np.float32(1 / ROOT), "u": UNIT, "h": HALF},
        ["Gelu"],
    ),
    (
        20,
        body(
            "a = Pow(x, p) b = Mul(a, k) c = Add(x, b) d = Mul(c, r) e = Tanh(d)",
            "f = Add(e, u) i = Mul(x, f) y = Mul(i, h)",
        ),
        {"p": np.float32(3), "u": UNIT, "h": HALF, **TANH},
        ["Gelu"],
    ),
    (
        20,
        body(
            "a = Pow(x, p) b = Mul(a, k) c = Add(x, b) d = Div(c, r) e = Tanh(d)",
            "f = Add(e, u) i = Mul(x, f) y = Mul(i, h)",
        ),
        {**TANH, "p": np.float32(3), "u": UNIT, "h": HALF, "r": 1 / TANH["r"]},
        ["Gelu"],
    ),
    (
        17,
        body("a = Neg(x) b = Exp(a) c = Add(b, u) y = Div(v, c)"),
        {"u": UNIT, "v": UNIT},
        ["Sigmoid"],
    ),
    (
        17,
        body("a = Add(x, three) b = Clip(a, zero, six) c = Mul(x, b) y = Div(c, six)"),
        BOUNDS,
        ["HardSwish"],
    ),
    (
        17,
        body("a = Add(x, three) b = Clip(a, zero, six) y = Div(b, six)"),
        BOUNDS,
        ["HardSigmoid"],
    ),
    (18, body("a = Softplus(x) b = Tanh(a) y = Mul(x, b)"), {}, ["Mish"]),
    (24, body("a = Sigmoid(x) y = Mul(x, a)"), {}, ["Sigmoid", "Mul"]),
    (
        17,
        body("a = Neg(x) b = Exp(a) c = Add(b, u) y = Div(u, c)"),
        {"u": UNIT},
        ["Sigmoid"],
    ),
    (
        17,
        body("a = Neg(x) b = Exp(a) c = Add(b, u) y = Reciprocal(c)"),
        {"u": UNIT},
        ["Sigmoid"],
    ),
    (  # a Sigmoid would lose the digits that the Log shows
        17,
        body(
            "a = Neg(x) b = Exp(a) c = Add(b, u) d = Reciprocal(c)",
            "e = Sub(u, d) f = Div(d, e) y = Log(f)",
        ),
        {"u": UNIT},
        ["Neg", "Exp", "Add", "Reciprocal", "Sub", "Div", "Log"],
    ),
    (  # behind a layer they are lost anyway
        17,
        body(
            "a = Neg(x) b = Exp(a) c = Add(b, u) d = Reciprocal(c)",
            "e = Softmax(d) y = Log(e)",
        ),
        {"u": UNIT},
        ["Sigmoid", "Softmax", "Log"],
    ),
    (17, body("a = Exp(x) b = Add(a, u) y = Log(b)"), {"u": UNIT}, ["Softplus"]),
    (
        17,
        body("a = Max(x, zero) y = Min(a, six)"),
        {k: BOUNDS[k] for k in ("zero", "six")},
        ["Clip"],
    ),
    (
        17,
        body("a = Min(six, x) y = Max(zero, a)"),
        {k: BOUNDS[k] for k in ("zero", "six")},
        ["Clip"],
    ),
    (17, body("a = Relu(x) y = Min(a, six)"), {"six": BOUNDS["six"]}, ["Clip"]),
    (
        17,
        body("a = Div(x, r) b = Erf(a) c = Add(b, u) d = Mul(x, c) y = Mul(d, h)"),
        {"r": ROOT, "u": UNIT, "h": np.float32(0.6)},
        ["Div", "Erf", "Add", "Mul", "Mul"],
    ),
]


@pytest.mark.parametrize(("version", "text", "weights", "left"), ACTIVATIONS)
def test_activations(
    version: int, text: str, weights: dict[str, Any], left: list[str]
) -> None:
    fuse_basic(opset(version) + text, left, **weights)


def test_gelu_needs_opset_20() -> None:
    version, text, weights, _ = ACTIVATIONS[0]
    model = read(opset(version - 3) + text, **weights)
    result = apply(FuseBasic(), model)
    assert result.changes == 0
    assert "left 1: Gelu needs opset 20" in result.notes


def test_bounds_the_wrong_way_round_stay() -> None:
    text = opset(17) + body("a = Max(x, six) y = Min(a, zero)")
    model = read(text, six=BOUNDS["six"], zero=BOUNDS["zero"])
    assert apply(FuseBasic(), model).changes == 0


def test_swish_is_written_when_asked_for() -> None:
    model = read(opset(24) + body("a = Sigmoid(x) y = Mul(x, a)"))
    apply(FuseBasic(swish=True), model)
    assert ops(model) == ["Swish"]


HARD_SWISH = "a = Add(x, three) b = Clip(a, zero, six) c = Div(b, k) y = Mul(x, c)"
FORMS = {
    "HardSwish": (HARD_SWISH, {"three": 3.0, "zero": 0.0, "six": 6.0}, 6.0),
    "Gelu": (
        "a = Div(x, root) b = Erf(a) c = Add(b, one) d = Mul(x, c) y = Mul(d, k)",
        {"root": np.sqrt(2), "one": 1.0},
        0.5,
    ),
    "Sigmoid": (
        "a = Neg(x) b = Exp(a) c = Add(b, k) y = Div(one, c)", {"one": 1.0}, 1.0,
    ),
    "Softplus": ("a = Exp(x) b = Add(a, k) y = Log(b)", {}, 1.0),
    "Clip": ("a = Relu(x) y = Min(a, k)", {}, 0.5),
    "LayerNormalization": (
        "m = ReduceMean<axes = [-1]>(x) d = Sub(x, m) s = Mul(d, d)"
        " v = ReduceMean<axes = [-1]>(s) w = Add(v, k) r = Sqrt(w) y = Div(d, r)",
        {},
        0.01,
    ),
}  # fmt: skip


@pytest.mark.parametrize("size", ["4", "n"])
@pytest.mark.parametrize("form", FORMS)
def test_the_result_keeps_the_axes_of_the_constant(form: str, size: str) -> None:
    body, scalars, constant = FORMS[form]
    opset = 20 if form == "Gelu" else 17
    text = (
        f'<ir_version: 9, opset_import: ["" : {opset}]>\n'
        f"g (float[{size}] x) => (float[1,{size}] y) {{ {body} }}"
    )
    given: dict[str, Any] = {k: np.float32(v) for k, v in scalars.items()}
    given["k"] = np.full((1, 1), constant, np.float32)
    model = read(text, **given)
    x = np.random.default_rng(2).normal(size=4).astype(np.float32)
    (want,) = compute(model, {"x": x})

    apply(FuseBasic(), model)

    (got,) = compute(model, {"x": x})
    assert got.shape == want.shape == (1, 4)
    np.testing.assert_allclose(got, want, rtol=1e-5)
