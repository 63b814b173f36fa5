from typing import Any

import numpy as np
import pytest

from me2e_compress.graph import digest, provenance
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, fuse_basic, normal, ops, opset, read

IMAGE = "float[1,4,6,6]"


def statistics(channels: int) -> dict[str, Any]:
    return {
        "gamma": normal(channels),
        "beta": normal(channels),
        "mean": normal(channels),
        "var": np.abs(normal(channels)) + 0.5,
    }


LAYERS = [
    ("Conv<pads = [1, 1, 1, 1]>(x, weight)", {"weight": normal(8, 4, 3, 3)}, 8),
    ("Conv(x, weight, bias)", {"weight": normal(8, 4, 1, 1), "bias": normal(8)}, 8),
    ("Conv<group = 2>(x, weight)", {"weight": normal(8, 2, 1, 1)}, 8),
    (
        "ConvTranspose(x, weight, bias)",
        {"weight": normal(4, 8, 2, 2), "bias": normal(8)},
        8,
    ),
    ("ConvTranspose<group = 2>(x, weight)", {"weight": normal(4, 3, 2, 2)}, 6),
]


@pytest.mark.parametrize(("layer", "weights", "channels"), LAYERS)
def test_a_normalization_goes_into_the_layer(
    layer: str, weights: dict[str, Any], channels: int
) -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[A,B,C,D] y) {{ a = {layer}"
        "  y = BatchNormalization(a, gamma, beta, mean, var) }"
    )
    after = fuse_basic(
        text, [layer.split("(")[0].split("<")[0]], **weights, **statistics(channels)
    )
    assert "weight" in after.graph.initializers


def test_gemm_takes_a_normalization() -> None:
    text = opset(17) + (
        "g (float[5,4] x) => (float[5,8] y) {"
        " a = Gemm<alpha = 0.5, beta = 2.0, transB = 1>(x, weight, bias)"
        " y = BatchNormalization(a, gamma, beta, mean, var) }"
    )
    fuse_basic(text, ["Gemm"], weight=normal(8, 4), bias=normal(8), **statistics(8))


@pytest.mark.parametrize("op", ["Add", "Sub", "Mul", "Div"])
@pytest.mark.parametrize("shape", [(8, 1, 1), (1, 8, 1, 1), (1,), ()])
def test_a_constant_per_channel_goes_into_the_convolution(
    op: str, shape: tuple[int, ...]
) -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = {op}(a, c) }}"
    )
    constant = np.asarray(np.abs(normal(*shape)) + 0.5, np.float32)
    fuse_basic(text, ["Conv"], weight=normal(8, 4, 1, 1), c=constant)


def test_a_constant_per_column_stays() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = Add(a, c) }}"
    )
    fuse_basic(text, ["Conv", "Add"], weight=normal(8, 4, 1, 1), c=normal(6))


def test_a_training_normalization_stays() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,8,6,6] y, float[8] m, float[8] v) {{"
        " a = Conv(x, weight)"
        " y, m, v = BatchNormalization<training_mode = 1>(a, gamma, beta, mean, var) }"
    )
    model = read(text, weight=normal(8, 4, 1, 1), **statistics(8))
    assert apply(FuseBasic(), model).changes == 0


def test_a_residual_add_stays_and_is_reported() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => ({IMAGE} y) {{ a = Conv(x, weight)"
        " b = Add(a, x) y = Relu(b) }"
    )
    model = read(text, weight=normal(4, 4, 1, 1))
    result = apply(FuseBasic(), model)
    assert result.changes == 0
    assert any("1 residual Conv + Add" in note for note in result.notes)


@pytest.mark.parametrize(
    ("shape", "left"),
    [("float[5,4]", ["Gemm"]), ("float[2,5,4]", ["MatMul", "Add"])],
)
def test_only_matrices_become_gemm(shape: str, left: list[str]) -> None:
    out = shape.replace("4]", "8]")
    text = (
        opset(17) + f"g ({shape} x) => ({out} y) {{ a = MatMul(x, w) y = Add(a, b) }}"
    )
    fuse_basic(text, left, w=normal(4, 8), b=normal(8))


def test_a_factor_goes_into_weight_and_bias() -> None:
    text = opset(17) + (
        "g (float[2,5,4] x) => (float[2,5,8] y) {"
        " a = MatMul(x, w) b = Add(a, bias) y = Mul(b, c) }"
    )
    fuse_basic(
        text, ["MatMul", "Add"], w=normal(4, 8), bias=normal(8), c=np.float32(0.35)
    )


def test_a_factor_is_folded_into_both_or_neither() -> None:
    text = opset(17) + (
        "g (float[2,5,4] x) => (float[2,5,8] y) {"
        " a = MatMul(x, w) b = Add(a, bias) y = Mul(b, c) }"
    )
    large = np.full((4, 8), 1e38, np.float32)
    model = read(text, w=large, bias=normal(8), c=np.float32(10))
    before = digest(model)

    result = apply(FuseBasic(), model)

    assert result.notes == ("left 1: a factor under which a weight would overflow",)
    assert digest(model) == before


def test_what_was_fused_owns_its_weights_at_once() -> None:
    text = opset(17) + (
        "g (float[5,4] x) => (float[5,8] y) {"
        " a = MatMul(x, w) b = Add(a, bias) y = Mul(b, c) }"
    )
    fuse_basic(text, ["Gemm"], w=normal(4, 8), bias=normal(8), c=normal(8))


def test_the_weight_of_a_constant_node_is_written_anew() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,1,6,6] y) {{"
        " weight = Constant<value = float[1,4,1,1] {1.0, 2.0, 3.0, 4.0}>()"
        " a = Conv(x, weight) y = Mul(a, c) }"
    )
    fuse_basic(text, ["Conv"], c=np.float32(3))


@pytest.mark.parametrize("op", ["Add", "Mul"])
def test_constants_in_a_row_are_combined(op: str) -> None:
    text = (
        opset(17)
        + f"g (float[2,4] x) => (float[2,4] y) {{ a = {op}(x, p) y = {op}(q, a) }}"
    )
    fuse_basic(text, [op], p=np.abs(normal(4)), q=np.abs(normal(1)))


def test_constants_that_cancel_stay() -> None:
    text = opset(17) + "g (float[4] x) => (float[4] y) { a = Add(x, p) y = Add(a, q) }"
    model = read(text, p=np.float32(1e6), q=np.float32(-1e6))
    assert apply(FuseBasic(), model).changes == 0


NORM = """
g (float[2,5,8] x) => (float[2,5,8] y) {
    mean = ReduceMean<axes = [-1]>(x)
    d = Sub(x, mean)
    sq = Pow(d, two)
    var = ReduceMean<axes = [-1]>(sq)
    safe = Add(var, eps)
    root = Sqrt(safe)
    n = Div(d, root)
    s = Mul(n, gamma)
    y = Add(s, beta)
}
"""
NORM_WEIGHTS: dict[str, Any] = {"two": np.float32(2), "eps": np.float32(1e-5)}


def test_layer_normalization() -> None:
    after = fuse_basic(
        opset(17) + NORM,
        ["LayerNormalization"],
        **NORM_WEIGHTS,
        gamma=normal(8),
        beta=normal(8),
    )
    node = after.graph.node(0)
    assert node.attributes.get_float("epsilon", 0.0) == pytest.approx(1e-5)
    past = provenance.read(node)
    assert past is not None
    assert set(past.origins) == {f"n{index}" for index in range(9)}


def test_a_layer_normalization_is_counted_once() -> None:
    model = read(opset(17) + NORM, **NORM_WEIGHTS, gamma=normal(8), beta=normal(8))
    assert apply(FuseBasic(), model).notes == ("fused: layer normalizations (1)",)


def test_layer_normalization_needs_opset_17() -> None:
    model = read(opset(13) + NORM, **NORM_WEIGHTS, gamma=normal(8), beta=normal(8))
    result = apply(FuseBasic(), model)
    assert result.changes == 0
    assert "left 1: LayerNormalization needs opset 17" in result.notes


def test_nothing_is_fused_into_a_body() -> None:
    text = """
    g (float[4,8] x, bool seen) => (float[4,6] y) {
        m = MatMul(x, w)
        c = Mul(m, two)
        y = If (seen) <then_branch = then () => (float[4,6] t) { t = Add(m, b) },
                       else_branch = other () => (float[4,6] e) { e = Mul(c, two) }>
    }
    """
    weights = {"w": normal(8, 6), "b": normal(6), "two": np.float32(2)}
    model = read(opset(17) + text, **weights)

    result = apply(FuseBasic(), model)

    assert result.changes == 0
    assert ops(model) == ["MatMul", "Mul", "If"]
