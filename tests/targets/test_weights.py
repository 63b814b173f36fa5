"""Rounding weights: each to its nearest step, or so that their errors cancel."""

import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import QuantPlan, make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets import TARGETS
from me2e_compress.targets.weights import (
    QuantizedWeight,
    balanced_steps,
    quantize_weight,
    weights_of,
)
from tests.nets import MODULES, net
from tests.profiles import scaled

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
    random = np.random.default_rng(0)
    shapes = {"w": (16, 16, 3, 3), "v": (16, 16), "u": (16, 16)}
    return net(NET % reads, {n: random.normal(size=s) for n, s in shapes.items()})


def stored(model: ir.Model, rules: str) -> tuple[QuantPlan, dict[str, QuantizedWeight]]:
    scheme = QuantScheme.named("full", MODULES)
    plan = make_plan(model, scheme, RULE_SETS.parse(rules))
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


@pytest.mark.parametrize("rules", ["paper", "safe{balance=false}"])
def test_the_paper_rounds_to_nearest(rules: str) -> None:
    model = made()
    plan, found = stored(model, rules)
    assert not plan.balanced
    assert "c" in found
    assert all((found[n].integers == nearest(model, n)).all() for n in found)


@pytest.mark.parametrize("target", ["tensorrt", "onnxruntime"])
@pytest.mark.parametrize("rules", ["paper", LOOSE])
def test_targets_round_as_the_plan_says(target: str, rules: str) -> None:
    model = made()
    plan, found = stored(model, rules)
    runtime = TARGETS.parse(target)
    tensors = dict.fromkeys(runtime.tensors(plan, model), (-3.0, 3.0))
    placed = runtime.place(model, plan, Ranges(tensors, "max-min", 1, "", ""))
    arrays = map(graph.array_of, placed.graph.initializers.values())
    (filters,) = (a for a in arrays if a is not None and a.shape == (16, 16, 3, 3))
    assert (filters == found["c"].integers).all()
    assert bool((filters != nearest(model, "c")).any()) == plan.balanced


def test_a_weight_that_two_layers_share_is_stored_once() -> None:
    model = made("v")
    _, found = stored(model, LOOSE)
    assert found["p"] is found["n"]
    assert (found["p"].integers == nearest(model, "p")).all()
