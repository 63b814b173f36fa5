"""Activations that are written out become one operator, where the opset has one."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, fuse_basic, opset, read


def body(lines: str) -> str:
    return f"g (float[3,7] x) => (float[3,7] y) {{ {lines} }}"


GIVEN: dict[str, Any] = {
    name: np.float32(value)
    for name, value in {
        "half": 0.5, "more": 0.6, "u": 1, "p": 3, "k": 0.044715,
        "root": np.sqrt(2), "part": 1 / np.sqrt(2), "r": np.sqrt(2 / np.pi),
        "s": np.sqrt(np.pi / 2),
    }.items()
}  # fmt: skip
GELU = "a = Div(x, root) b = Erf(a) c = Add(b, u) d = Mul(x, c) y = Mul(d, half)"
TANH = "a = Pow(x, p) b = Mul(a, k) c = Add(x, b) d = {} e = Tanh(d) f = Add(e, u)"
MADE = "i = Mul(x, f) y = Mul(i, half)"
ACTIVATIONS: list[tuple[int, str, list[str]]] = [
    (20, GELU, ["Gelu"]),
    (
        20,
        "a = Mul(x, part) b = Erf(a) c = Add(u, b) d = Mul(x, half) y = Mul(d, c)",
        ["Gelu"],
    ),
    (20, f"{TANH.format('Mul(c, r)')} {MADE}", ["Gelu"]),
    (20, f"{TANH.format('Div(c, s)')} {MADE}", ["Gelu"]),
    (24, "a = Sigmoid(x) y = Mul(x, a)", ["Sigmoid", "Mul"]),
    (17, GELU.replace("half", "more"), ["Div", "Erf", "Add", "Mul", "Mul"]),
]


@pytest.mark.parametrize(("version", "lines", "left"), ACTIVATIONS)
def test_activations(version: int, lines: str, left: list[str]) -> None:
    fuse_basic(opset(version) + body(lines), left, **GIVEN)


def test_gelu_needs_opset_20() -> None:
    result = apply(FuseBasic(), read(body(GELU), **GIVEN))
    assert result.changes == 0
    assert "left 1: Gelu needs opset 20" in result.notes


FORMS = {
    "Gelu": (
        "a = Div(x, root) b = Erf(a) c = Add(b, one) d = Mul(x, c) y = Mul(d, k)",
        {"root": np.sqrt(2), "one": 1.0},
        0.5,
    ),
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
