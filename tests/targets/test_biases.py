"""Scales leave room for the biases beside them, and stay what they were elsewhere."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.graph import producer_of
from me2e_compress.graph.nodes import numbers_of
from me2e_compress.quantization.decision import QuantPlan
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.targets.weights import (
    BIAS_MAX,
    QuantizedWeight,
    balanced_steps,
    bias_by_channel,
    least_scales,
    quantize_weight,
    requantized,
    scales_in,
    weights_of,
    with_room,
)
from tests.support.nets import FULL, drawn, net, placed
from tests.support.profiles import scaled

DEAD = """
<ir_version: 9, opset_import: ["" : 19]>
net (float[1,8,6,6] x, float[6,8] t, float[8,8,3,3] conv, float[8] b1,
     float[8,8,3,3] up, float[8] b2, float[8,8] right, float[8] b3,
     float[8,8] turned, float[8] b4, float[8,8] matrix, float[1,8] b5, float[8] b6)
    => (float[1,8,4,4] a, float[1,8,8,8] b, float[6,8] c, float[6,8] d, float[6,8] e,
        float[6,8] f) {
    a = Conv<kernel_shape=[3,3]>(x, conv, b1)
    b = ConvTranspose<kernel_shape=[3,3]>(x, up, b2)
    c = Gemm(t, right, b3)
    d = Gemm<transB=1>(t, turned, b4)
    p = MatMul(t, matrix)
    e = Add(p, b5)
    s = Tanh(t)
    q = MatMul(s, matrix)
    f = Add(b6, q)
}
"""
AXES = {"conv": 0, "up": 1, "right": 1, "turned": 0, "matrix": 1}
DEAD_CHANNEL = 3


def dead(seed: int, faint: float) -> ir.Model:
    """Draw layers of which one channel has weights of ``faint`` and a bias."""
    random = np.random.default_rng(seed)
    weights = {}
    for name, axis in AXES.items():
        size = (8, 8, 3, 3) if name in ("conv", "up") else (8, 8)
        rows = random.normal(size=size)
        np.moveaxis(rows, axis, 0)[DEAD_CHANNEL] *= faint
        weights[name] = rows
    for index in range(1, 7):
        weights[f"b{index}"] = random.normal(size=(1, 8) if index == 5 else 8) + 1
    # the second reader of a weight has the larger bias
    weights["b6"] = weights["b6"] * 50
    return net(DEAD, weights)


def in_int8(model: ir.Model) -> ir.Model:
    return placed(model, ends=(-3.0, 2.0))


def counts(model: ir.Model) -> list[float]:
    """Count the steps of every float bias in units of input times weight."""
    found = []
    for node in model.graph:
        if node.op_type not in ("Conv", "ConvTranspose", "Gemm", "MatMul"):
            continue
        pairs = [producer_of(value) for value in node.inputs[:2]]
        left, right = (
            None if n is None else graph.array_of(n.inputs[1]) for n in pairs
        )
        bias = bias_by_channel(node, 8)
        if left is not None and right is not None and bias is not None:
            steps = left.astype(np.float64) * right.astype(np.float64)
            found.append(float(np.abs(bias / steps).max()))
    return found


@settings(max_examples=scaled(40))
@given(seed=st.integers(0, 2**32 - 1), exponent=st.floats(-14, 0))
def test_no_bias_of_a_placed_graph_wraps(seed: int, exponent: float) -> None:
    model = in_int8(dead(seed, 10.0**exponent))

    steps = counts(model)

    assert len(steps) == 6
    assert max(steps) <= BIAS_MAX * (1 + 1e-6)


def test_only_the_channel_that_needs_it_changes() -> None:
    source, model = dead(0, 1e-12), in_int8(dead(0, 1e-12))
    for name, axis in AXES.items():
        weight = graph.array_of(source.graph.initializers[name])
        assert weight is not None
        integers, scales = quantize_weight(weight.astype(np.float32), axis)
        written = graph.array_of(model.graph.initializers[f"{name}_int8"])
        steps = numbers_of(model.graph.initializers[f"{name}_scale"])
        assert written is not None
        assert steps is not None

        raised = np.flatnonzero(scales != steps)

        assert raised.tolist() == [DEAD_CHANNEL]
        assert (steps >= scales).all()
        others = np.delete(integers, DEAD_CHANNEL, axis)
        np.testing.assert_array_equal(np.delete(written, DEAD_CHANNEL, axis), others)


@settings(max_examples=scaled(100))
@given(
    seed=st.integers(0, 2**32 - 1),
    bias=st.floats(-12, 12),
    step=st.floats(-6, 3),
    axis=st.sampled_from((0, 1, None)),
)
def test_a_raised_scale_is_the_least_that_fits(
    seed: int, bias: float, step: float, axis: int | None
) -> None:
    random = np.random.default_rng(seed)
    exact = random.normal(size=(5, 5)).astype(np.float32)
    weight = QuantizedWeight("w", *quantize_weight(exact, axis), axis)
    added = (random.normal(size=5) * 10.0**bias).astype(np.float32)
    unit = np.float32(10.0**step)

    roomy = with_room(weight, least_scales(added, unit))

    steps = np.abs(added) / (roomy.scales.astype(np.float64) * unit)
    assert steps.max() <= BIAS_MAX * (1 + 1e-6)
    kept = roomy.scales == weight.scales
    most = steps.max() if axis is None else steps[~kept]
    assert kept.all() or np.allclose(most, BIAS_MAX, rtol=1e-6)
    assert (roomy is weight) == bool(kept.all())


@settings(max_examples=scaled(100))
@given(exponent=st.floats(-45, 4))
def test_float16_holds_every_scale(exponent: float) -> None:
    exact = np.array([10.0**exponent, 1.0], np.float32)

    half = scales_in(exact, np.float16)

    assert half.dtype == np.float16
    assert (half > 0).all() or not exact[0]
    if exact[0] < np.finfo(np.float16).smallest_normal:  # rounded up: nothing clips
        assert half[0] >= exact[0]
    else:
        np.testing.assert_allclose(half, exact, rtol=2.0**-11)


@settings(max_examples=scaled(100))
@given(
    seed=st.integers(0, 2**32 - 1),
    kind=st.sampled_from(("int8", "uint8", "int32")),
    ratio=st.floats(1, 1e6),
)
def test_integers_of_a_larger_scale_are_off_by_half_a_step(
    seed: int, kind: str, ratio: float
) -> None:
    random = np.random.default_rng(seed)
    limits = np.iinfo(kind)
    stored = random.integers(limits.min, limits.max, (4, 6), endpoint=True).astype(kind)
    zero = np.full(6, 128 if kind == "uint8" else 0, kind)
    scales = random.uniform(1e-7, 1e-3, 6).astype(np.float32)
    fresh = (scales * np.float32(ratio)).astype(np.float32)

    again = requantized(stored, scales, fresh, 1, zero)

    before = (stored.astype(np.float64) - zero) * scales
    after = (again.astype(np.float64) - zero) * fresh
    assert again.dtype == stored.dtype
    assert (np.abs(before - after) <= fresh.astype(np.float64) * (0.5 + 1e-6)).all()


# Rounding weights: each to its nearest step, or so that their errors cancel.


NET = """
net (float[1,16,8,8] x, float[16,16,3,3] w, float[16,16] v, float[16,16] u)
    => (float[1,8,8,16] p, float[1,8,8,16] n) {
    c = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(x, w)
    t = Transpose<perm=[0,2,3,1]>(c)
    r = Relu(t)
    p = MatMul(r, v)
    n = MatMul(t, %s)
}
"""
LOOSE = "safe{without=[small-product,narrow-convolution]}"


def made(reads: str = "u") -> ir.Model:
    return drawn(NET % reads, {"w": (16, 16, 3, 3), "v": (16, 16), "u": (16, 16)})


def stored(model: ir.Model, rules: str) -> tuple[QuantPlan, dict[str, QuantizedWeight]]:
    plan = make_plan(model, FULL, RULE_SETS.parse(rules))
    return plan, weights_of(model, plan.chosen, balanced=plan.balanced)


def nearest(model: ir.Model, output: str) -> np.ndarray:
    node = next(n for n in model.graph if n.outputs[0].name == output)
    weight = graph.array_of(node.inputs[1])
    assert weight is not None
    wide = weight.astype(np.float32)
    return quantize_weight(wide, 0 if node.op_type == "Conv" else 1)[0]


@settings(max_examples=scaled(50))
@given(seed=st.integers(0, 2**32 - 1), axis=st.integers(0, 2))
def test_a_weight_is_off_by_half_a_step_at_most(seed: int, axis: int) -> None:
    weight = np.random.default_rng(seed).standard_normal((3, 4, 5)).astype(np.float32)

    integers, scales = quantize_weight(weight, axis)

    shape = [1, 1, 1]
    shape[axis] = -1
    error = np.abs(integers * scales.reshape(shape) - weight)
    assert (error <= scales.reshape(shape) * 0.5001).all()
    others = tuple(each for each in range(3) if each != axis)
    assert (np.abs(integers).max(axis=others) == 127).all()


def test_a_channel_of_zeros_stays_zero() -> None:
    integers, scales = quantize_weight(np.zeros((2, 3), np.float32), 0)

    assert not integers.any()
    assert scales.tolist() == [1, 1]


@given(st.integers(0, 2**32 - 1), st.integers(1, 9), st.integers(1, 40))
def test_errors_of_a_channel_and_its_kernels_cancel(
    seed: int, elements: int, inputs: int
) -> None:
    random = np.random.default_rng(seed)
    exact = random.uniform(-127, 127, (3, inputs, elements)).astype(np.float32)
    error = balanced_steps(exact) - exact
    assert np.abs(error).max() < 1
    assert np.abs(error.sum(2)).max() <= 1 + 1e-9
    assert np.abs(error.sum((1, 2))).max() <= 0.5 + 1e-9


def test_what_lies_near_an_integer_moves_last() -> None:
    exact = np.array([[[0.4, 0.1, 0.3, 0.0]]], np.float32)
    assert balanced_steps(exact).tolist() == [[[1, 0, 0, 0]]]


def test_a_weight_on_its_grid_stays() -> None:
    steps = np.random.default_rng(0).integers(-127, 128, (4, 8, 9))
    assert (balanced_steps(steps.astype(np.float32)) == steps).all()


@pytest.mark.parametrize("axis", [0, 1])
def test_channels_keep_their_axis(axis: int) -> None:
    weight = np.random.default_rng(1).normal(size=(6, 5, 3, 3)).astype(np.float32)
    integers, scales = quantize_weight(weight, axis, balanced=True)
    sides = np.moveaxis(integers, axis, 0).reshape(len(scales), -1)
    exact = np.moveaxis(weight, axis, 0).reshape(len(scales), -1) / scales[:, None]
    assert np.abs((sides - exact).sum(1)).max() <= 0.5 + 1e-3


def test_convolutions_and_products_behind_a_relu_are_balanced() -> None:
    model = made()
    plan, found = stored(model, LOOSE)
    assert plan.balanced
    changed = {
        name: bool((found[name].integers != nearest(model, name)).any())
        for name in ("c", "p", "n")
    }
    assert changed == {"c": True, "p": True, "n": False}


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
@pytest.mark.parametrize("rules", ["paper", LOOSE])
def test_targets_round_as_the_plan_says(target: str, rules: str) -> None:
    model = made()
    plan, found = stored(model, rules)
    small = placed(model, target, rules)
    arrays = map(graph.array_of, small.graph.initializers.values())
    (filters,) = (a for a in arrays if a is not None and a.shape == (16, 16, 3, 3))
    assert (filters == found["c"].integers).all()
    assert bool((filters != nearest(model, "c")).any()) == plan.balanced


def test_a_weight_that_two_layers_share_is_stored_once() -> None:
    model = made("v")
    _, found = stored(model, LOOSE)
    assert found["p"] is found["n"]
    assert (found["p"].integers == nearest(model, "p")).all()
