"""A layer times zero keeps the sign of every zero: 1 / -0 is not 1 / 0."""

import numpy as np
import pytest

from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, read

LAYERS = {
    "Gemm": ("Gemm(x, w, b)", "float[5,4]"),
    "MatMul": ("MatMul(x, w)", "float[5,4]"),
    "Conv": ("Conv(x, k, b)", "float[5,4,2,2]"),
}


@pytest.mark.parametrize(
    ("factor", "constant"), [("Mul", 0.0), ("Mul", -0.0), ("Div", -np.inf)]
)
@pytest.mark.parametrize("layer", LAYERS)
def test_a_factor_of_zero_stays_behind_its_layer(
    layer: str, factor: str, constant: float
) -> None:
    call, kind = LAYERS[layer]
    text = (
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"g ({kind} x) => ({kind} y)"
        f" {{ a = {call} c = {factor}(a, z) y = Reciprocal(c) }}"
    )
    draws = np.random.default_rng(4)
    given = {
        "w": draws.normal(size=(4, 4)).astype(np.float32),
        "b": draws.normal(size=4).astype(np.float32),
        "k": draws.normal(size=(4, 4, 1, 1)).astype(np.float32),
    }
    used = {name: each for name, each in given.items() if name in call[4:]}
    model = read(text, z=np.float32(constant), **used)
    shape = (5, 4, 2, 2) if layer == "Conv" else (5, 4)
    feeds = {"x": draws.normal(size=shape).astype(np.float32)}
    (want,) = compute(model, feeds)

    apply(FuseBasic(), model)

    (got,) = compute(model, feeds)
    np.testing.assert_array_equal(got, want)
