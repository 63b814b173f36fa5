"""TensorRT-RTX itself, where the extra is installed; a few seconds a graph."""

import importlib.util

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import MissingExtraError, PreconditionError, RecipeError
from me2e_compress.graph.modules.assign import map_of
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.quantization.decision import QuantScheme, stamp_plan
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.shipped.drivers import shipped_model
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import (
    check,
    cut,
)
from tests.support.nets import FULL, conv_attention, net, parsed, placed
from tests.targets.tensorrt.layers import layers

RTX = pytest.mark.skipif(
    importlib.util.find_spec("tensorrt_rtx") is None, reason="extra trt-check"
)


def quantized(
    model: ir.Model, scheme: QuantScheme = FULL, rules: str = "paper"
) -> ir.Model:
    """Place int8; what is built does not hang on the values of the scales."""
    small = placed(model, rules=rules, scheme=scheme)
    stamp_plan(small, make_plan(model, scheme, RULE_SETS.parse(rules)))
    return small


@RTX
def test_what_we_place_is_built() -> None:
    found = check(quantized(conv_attention()))

    assert (found.passed, found.parsed, found.built) == (True, True, True)


@RTX
def test_every_kind_of_layer_is_taken_with_its_channels() -> None:
    """Conv, grouped ConvTranspose, MatMul, turned Gemm, a residual Add; no names."""
    for model in (layers(), residual()):
        found = check(quantized(model))
        assert (found.passed, found.built) == (True, True)


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


HEAD = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>'
ROTATED = (
    HEAD + "m (float[2,4,4] x, float[1] a) => (float[2,4,4] y)"
    " <float[2] c = {1.0, 1.0}> { e = Relu(x) b = Neg(a)"
    ' ["/Rotate"] r = trt.RotateTRT<interpolation=1>(e, b, c) y = Exp(r) }'
)


def typed(text: str) -> ir.Model:
    """Read a graph; what plugins give has the shape of their first input."""
    model = ir.from_onnx_text(text)
    graph.infer_shapes(model)
    for node in model.graph:
        if node.domain == "trt" and node.inputs[0] is not None:
            node.outputs[0].shape = node.inputs[0].shape
            node.outputs[0].type = node.inputs[0].type
    return model


def test_what_a_plugin_reads_and_gives_become_outputs_and_inputs() -> None:
    model = typed(ROTATED)
    before = graph.digest(model)

    part, gone = cut(model)

    assert graph.digest(model) == before  # the source stays whole
    _, bare = cut(typed(ROTATED.replace("trt.Rotate", "Rotate")))
    assert bare == gone  # without a domain, too
    assert gone == ("/Rotate",)
    assert [node.op_type for node in part.graph] == ["Relu", "Neg", "Exp"]
    assert [value.name for value in part.graph.inputs] == ["x", "a", "r"]
    assert [value.name for value in part.graph.outputs] == ["y", "e", "b"]


def test_a_plugin_at_the_end_takes_its_output_along() -> None:
    model = typed(
        HEAD + "m (float[2,4,4] x) => (float[2,4,4] y)"
        " { e = Relu(x) y = trt.InverseTRT(e) }"
    )
    part, _ = cut(model)

    assert [value.name for value in part.graph.outputs] == ["e"]


def test_operators_that_only_tensorrt_has_are_cut_too() -> None:
    model = typed(
        HEAD.replace("17", "19")
        + "m (float[1,2,4,4] x, float[1,2,1,1] w, float[1,2,4,4] o) =>"
        " (float[1,1,4,4] y) { c = DeformConv(x, w, o) y = Relu(c) }"
    )
    _, gone = cut(model)

    assert gone == ("c",)


def test_a_local_function_is_no_plugin() -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17, "own" : 1]>
    m (float[2] x) => (float[2] y) { y = own.Twice(x) }
    <domain: "own", opset_import: ["" : 17]>
    Twice (x) => (y) { y = Add(x, x) }
    """
    part, gone = cut(ir.from_onnx_text(text))

    assert gone == ()
    assert len(part.functions) == 1


def test_a_plugin_of_unknown_result_cannot_be_cut_at() -> None:
    with pytest.raises(PreconditionError, match="output r is not known"):
        cut(ir.from_onnx_text(ROTATED))


# The driver that ships, in every scheme, as TensorRT gets it.


SCHEMES = ("feature-ext", "prediction", "full")


@pytest.fixture(scope="module")
def driver() -> ir.Model:
    """After the exact passes, unverified: that is asked elsewhere."""
    loaded = graph.load(shipped_model("highway"))
    context = Context(map_of(loaded, None))
    model = PassManager(recipe.load("exact"), verify_frames=0).run(loaded, context)
    graph.infer_shapes(model.model)
    return model.model


def driver_in_int8(model: ir.Model, scheme: str, rules: str) -> ir.Model:
    return quantized(model, QuantScheme.named(scheme, map_of(model, None)), rules)


@pytest.mark.parametrize(
    ("scheme", "rules"), [("full", "safe"), ("full", "paper"), ("prediction", "safe")]
)
def test_schemes_pass_the_lint(driver: ir.Model, scheme: str, rules: str) -> None:
    small = driver_in_int8(driver, scheme, rules)

    assert TensorRT(version="10.7").lint(small) == ()
    assert any(node.op_type == "QuantizeLinear" for node in small.graph)


@pytest.mark.slow
@RTX
@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_is_built(driver: ir.Model, scheme: str) -> None:
    found = check(driver_in_int8(driver, scheme, "paper"))

    assert found.passed, found.errors
    assert found.cut == ()
