from typing import Any

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.graph import digest, provenance, static_shape
from me2e_compress.passes.fuse_basic import FuseBasic
from tests.passes.small import apply, compute, ops, read

IMAGE = "float[1,4,6,6]"
RANDOM = np.random.default_rng(7)


def opset(version: int) -> str:
    return f'<ir_version: 9, opset_import: ["" : {version}]>\n'


def normal(*shape: int) -> Any:
    return RANDOM.normal(size=shape).astype(np.float32)


def statistics(channels: int) -> dict[str, Any]:
    return {
        "gamma": normal(channels),
        "beta": normal(channels),
        "mean": normal(channels),
        "var": np.abs(normal(channels)) + 0.5,
    }


def check(text: str, left: list[str], **weights: Any) -> ir.Model:
    """Fuse; compare operators, and values within 1e-4 of the largest."""
    before, after = read(text, **weights), read(text, **weights)
    apply(FuseBasic(), after)
    assert ops(after) == left
    feeds = {
        port.name or "": normal(*(static_shape(port) or ()))
        for port in before.graph.inputs
    }
    for want, got in zip(compute(before, feeds), compute(after, feeds), strict=True):
        np.testing.assert_allclose(got, want, rtol=0, atol=1e-4 * np.abs(want).max())
    return after


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
    after = check(
        text, [layer.split("(")[0].split("<")[0]], **weights, **statistics(channels)
    )
    assert "weight" in after.graph.initializers


def test_gemm_takes_a_normalization() -> None:
    text = opset(17) + (
        "g (float[5,4] x) => (float[5,8] y) {"
        " a = Gemm<alpha = 0.5, beta = 2.0, transB = 1>(x, weight, bias)"
        " y = BatchNormalization(a, gamma, beta, mean, var) }"
    )
    check(text, ["Gemm"], weight=normal(8, 4), bias=normal(8), **statistics(8))


@pytest.mark.parametrize("op", ["Add", "Sub", "Mul", "Div"])
@pytest.mark.parametrize("shape", [(8, 1, 1), (1, 8, 1, 1), (1,), ()])
def test_a_constant_per_channel_goes_into_the_convolution(
    op: str, shape: tuple[int, ...]
) -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = {op}(a, c) }}"
    )
    constant = np.asarray(np.abs(normal(*shape)) + 0.5, np.float32)
    check(text, ["Conv"], weight=normal(8, 4, 1, 1), c=constant)


def test_a_constant_per_column_stays() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,8,6,6] y) {{ a = Conv(x, weight) y = Add(a, c) }}"
    )
    check(text, ["Conv", "Add"], weight=normal(8, 4, 1, 1), c=normal(6))


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
    check(text, left, w=normal(4, 8), b=normal(8))


def test_a_factor_goes_into_weight_and_bias() -> None:
    text = opset(17) + (
        "g (float[2,5,4] x) => (float[2,5,8] y) {"
        " a = MatMul(x, w) b = Add(a, bias) y = Mul(b, c) }"
    )
    check(text, ["MatMul", "Add"], w=normal(4, 8), bias=normal(8), c=np.float32(0.35))


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
    check(text, ["Gemm"], w=normal(4, 8), bias=normal(8), c=normal(8))


def test_the_weight_of_a_constant_node_is_written_anew() -> None:
    text = opset(17) + (
        f"g ({IMAGE} x) => (float[1,1,6,6] y) {{"
        " weight = Constant<value = float[1,4,1,1] {1.0, 2.0, 3.0, 4.0}>()"
        " a = Conv(x, weight) y = Mul(a, c) }"
    )
    check(text, ["Conv"], c=np.float32(3))


@pytest.mark.parametrize("op", ["Add", "Mul"])
def test_constants_in_a_row_are_combined(op: str) -> None:
    text = (
        opset(17)
        + f"g (float[2,4] x) => (float[2,4] y) {{ a = {op}(x, p) y = {op}(q, a) }}"
    )
    check(text, [op], p=np.abs(normal(4)), q=np.abs(normal(1)))


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
    after = check(
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
    check(opset(version) + text, left, **weights)


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
