"""TensorRT-RTX itself, where the extra is installed; a few seconds a graph."""

import importlib.util

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.errors import MissingExtraError, RecipeError
from me2e_compress.quantization.plan import make_plan, stamp_plan, tensors_of
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import check
from tests.nets import MODULES, PAPER, conv_attention, net, parsed
from tests.targets.tensorrt.layers import layers

RTX = pytest.mark.skipif(
    importlib.util.find_spec("tensorrt_rtx") is None, reason="extra trt-check"
)


def quantized(model: ir.Model) -> ir.Model:
    plan = make_plan(model, QuantScheme.named("full", MODULES), PAPER)
    ranges = dict.fromkeys(tensors_of(plan, model), (-3.0, 3.0))
    placed = TensorRT().place(model, plan, Ranges(ranges, "max-min", 1, "", ""))
    stamp_plan(placed, plan)
    return placed


@RTX
def test_what_we_place_is_built_with_int8_kernels() -> None:
    found = check(quantized(conv_attention()))

    assert found.passed
    assert (found.parsed, found.built, found.missing) == (True, True, ())
    convolutions = [each for each in found.kernels if each.kind == "convolution"]
    assert [each.is_int8 for each in convolutions] == [True]


@RTX
def test_every_kind_of_layer_is_taken_with_its_channels() -> None:
    """Conv, grouped ConvTranspose, MatMul, turned Gemm, a residual Add; no names."""
    for model in (layers(), residual()):
        found = check(quantized(model))
        assert (found.passed, found.missing) == (True, ())


def residual() -> ir.Model:
    text = """
    block (float[1,4,5,5] x, float[4,4,3,3] w) => (float[1,4,5,5] y) {
        r = Relu(x)
        a = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(r, w)
        s = Add(a, r)
        y = Relu(s)
    }
    """
    return net(text, {"w": np.ones((4, 4, 3, 3))})


@RTX
def test_a_float_graph_has_no_int8_kernel() -> None:
    found = check(conv_attention())

    assert found.passed
    assert found.missing is None
    assert not any(each.is_int8 for each in found.kernels)


@RTX
def test_a_plan_that_the_graph_does_not_keep_is_found_out() -> None:
    model = conv_attention()
    plan = make_plan(model, QuantScheme.named("full", MODULES), PAPER)
    stamp_plan(model, plan)

    found = check(model)

    assert not found.passed
    assert found.missing == ("/backbone/Conv",)


@RTX
def test_what_the_parser_refuses_is_named() -> None:
    text = """
    m (float[2,4] x) => (float[2,4] y)
    <float s = {0.5}, int8 z = {3}> {
        q = QuantizeLinear(x, s, z)
        d = DequantizeLinear(q, s, z)
        y = Relu(d)
    }
    """
    found = check(parsed(text), build=False)

    assert not found.passed
    assert found.built is None
    assert any("QuantizeLinear" in each for each in found.errors)


@RTX
def test_a_generation_that_nobody_builds_for() -> None:
    with pytest.raises(RecipeError, match="no GPU generation 61; there are 75, 80, 86"):
        check(conv_attention(), sm=61)


def test_without_the_extra_it_says_what_to_install(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(importlib.util, "find_spec", lambda name: None)

    with pytest.raises(MissingExtraError, match=r"me2e-compress\[trt-check\]"):
        check(conv_attention())
