"""Normalizations, products and constants that one standard operator can express."""

from typing import Any

import numpy as np
import pytest

from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, fuse_basic, normal, ops, preserved, read

IMAGE = "float[1,4,6,6]"


def statistics(channels: int) -> dict[str, Any]:
    return {
        "gamma": normal(channels),
        "beta": normal(channels),
        "mean": normal(channels),
        "var": np.abs(normal(channels)) + 0.5,
    }


BIAS = {"bias": normal(8)}
LAYERS = [
    ("Conv<pads = [1, 1, 1, 1]>(x, weight)", {"weight": normal(8, 4, 3, 3)}, 8),
    ("Conv(x, weight, bias)", BIAS | {"weight": normal(8, 4, 1, 1)}, 8),
    ("Conv<group = 2>(x, weight)", {"weight": normal(8, 2, 1, 1)}, 8),
    ("ConvTranspose(x, weight, bias)", BIAS | {"weight": normal(4, 8, 2, 2)}, 8),
    ("ConvTranspose<group = 2>(x, weight)", {"weight": normal(4, 3, 2, 2)}, 6),
    (
        "Gemm<alpha = 0.5, beta = 2.0, transB = 1>(x, weight, bias)",
        BIAS | {"weight": normal(8, 4)},
        8,
    ),
]


@pytest.mark.parametrize(("layer", "weights", "channels"), LAYERS)
def test_a_normalization_goes_into_the_layer(
    layer: str, weights: dict[str, Any], channels: int
) -> None:
    op = layer.split("(")[0].split("<")[0]
    x, y = ("float[5,4]", "float[5,8]") if op == "Gemm" else (IMAGE, "float[A,B,C,D]")
    text = (
        f"g ({x} x) => ({y} y) {{ a = {layer}"
        "  y = BatchNormalization(a, gamma, beta, mean, var) }"
    )
    after = fuse_basic(text, [op], **weights, **statistics(channels))
    assert "weight" in after.graph.initializers or op == "Gemm"


@pytest.mark.parametrize("op", ["Add", "Mul"])
@pytest.mark.parametrize("shape", [(8, 1, 1), (1, 8, 1, 1), (1,), ()])
def test_constants_per_channel_are_folded(op: str, shape: tuple[int, ...]) -> None:
    text = (
        f"g ({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = {op}(a, c) }}"
    )
    constant = np.asarray(np.abs(normal(*shape)) + 0.5, np.float32)
    fuse_basic(text, ["Conv"], weight=normal(8, 4, 1, 1), c=constant)


STAYS = {
    "a constant of every column": (
        f"({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = Add(a, c) }}",
        {"weight": normal(8, 4, 1, 1), "c": normal(6)},
    ),
    "a normalization that trains": (
        f"({IMAGE} x) => (float[1,8,6,6] y, float[8] m, float[8] v) {{"
        " a = Conv(x, weight)"
        " y, m, v = BatchNormalization<training_mode = 1>(a, gamma, beta, mean, var) }",
        {"weight": normal(8, 4, 1, 1), **statistics(8)},
    ),
}


@pytest.mark.parametrize("case", STAYS)
def test_what_stays(case: str) -> None:
    text, weights = STAYS[case]
    assert apply(FuseBasic(), read(f"g {text}", **weights)).changes == 0


def test_a_residual_add_stays() -> None:
    text = (
        f"g ({IMAGE} x) => ({IMAGE} y) {{ a = Conv(x, weight)"
        " b = Add(a, x) y = Relu(b) }"
    )
    model = read(text, weight=normal(4, 4, 1, 1))
    result = apply(FuseBasic(), model)
    assert result.changes == 0


@pytest.mark.parametrize(
    ("shape", "left"), [("float[5,4]", ["Gemm"]), ("float[2,5,4]", ["MatMul", "Add"])]
)
def test_only_matrices_become_gemm(shape: str, left: list[str]) -> None:
    out = shape.replace("4]", "8]")
    text = f"g ({shape} x) => ({out} y) {{ a = MatMul(x, w) y = Add(a, b) }}"
    fuse_basic(text, left, w=normal(4, 8), b=normal(8))


SUM = (
    "g (float[5,4] x) => (float[5,8] y) {"
    " a = MatMul(x, w) b = Add(a, bias) y = Mul(b, c) }"
)


def test_a_factor_of_a_sum_just_fused_goes_into_weight_and_bias() -> None:
    fuse_basic(SUM, ["Gemm"], w=normal(4, 8), bias=normal(8), c=normal(8))


def test_a_factor_under_which_a_weight_would_overflow_stays() -> None:
    large = np.full((4, 8), 1e38, np.float32)
    model = read(SUM, w=large, bias=normal(8), c=np.float32(10))

    result = apply(FuseBasic(), model)

    assert "left 1: Gemm whose weights would overflow" in result.notes
    assert ops(model) == ["Gemm", "Mul"]


def test_the_weight_of_a_constant_node_is_written_anew() -> None:
    text = (
        f"g ({IMAGE} x) => (float[1,1,6,6] y) {{"
        " weight = Constant<value = float[1,4,1,1] {1.0, 2.0, 3.0, 4.0}>()"
        " a = Conv(x, weight) y = Mul(a, c) }"
    )
    fuse_basic(text, ["Conv"], c=np.float32(3))


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
    model = read(text, **weights)

    result = apply(FuseBasic(), model)

    assert result.changes == 0
    assert ops(model) == ["MatMul", "Mul", "If"]


def test_a_weight_that_others_read_stays() -> None:
    """The first layer is followed by a sum alone, which its bias takes."""
    text = """
    g (float[1,4,5,5] x1, float[1,4,5,5] x2, float[1,4,5,5] x3)
        => (float[1,4,5,5] y1, float[1,4,5,5] y2, float[1,4,5,5] y3) {
        a1 = Conv(x1, W)
        y1 = Add(a1, one)
        a2 = Conv(x2, W)
        y2 = Mul(a2, two)
        y3 = Conv(x3, W)
    }"""
    given = {"W": normal(4, 4, 1, 1), "one": np.float32(1), "two": np.float32(2)}
    after, result = preserved(FuseBasic(), text, 1e-4, **given)

    assert ops(after) == ["Conv", "Conv", "Mul", "Conv"]
    assert "left 1: Conv that shares its weights" in result.notes
