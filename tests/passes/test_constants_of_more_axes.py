"""A constant of more axes than what it meets gives the result its axes, too."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, read

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
