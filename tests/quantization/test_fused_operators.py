"""Fused operators in a plan: a decision with a reason, as for any layer."""

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.quantization.plan import Decision, Overrides, make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets import TARGETS
from tests.nets import MODULES, net

HEAD = QuantScheme.of(("head",), MODULES)
SAMPLED = """
<ir_version: 9, opset_import: ["" : 17, "DOMAIN" : 1]>
net (TYPE[1,63,3,8] value, TYPE[1,50,3,2,4,2] at, TYPE[1,50,3,2,4] shares)
    => (TYPE[1,50,3,8] y)
<int32[2,2] sizes = {5, 11, 2, 4}, int32[2] starts = {0, 55}> {
    ["/head/sampled"] y = DOMAIN.NAME(value, sizes, starts, at, shares)
}
"""
TO_INT8 = Overrides.parse('[[override]]\nnodes = "/head/sampled"\ndtype = "int8"')


def sampled(
    domain: str = "me2e",
    name: str = "MultiScaleDeformableAttention",
    kind: str = "float",
    **weights: npt.NDArray[np.float64],
) -> ir.Model:
    text = SAMPLED.replace("DOMAIN", domain).replace("NAME", name)
    return net(text.replace("TYPE", kind), weights)


def decided(
    model: ir.Model,
    rules: str = "safe",
    *,
    target: str = "onnxruntime",
    scheme: QuantScheme = HEAD,
    overrides: Overrides | None = None,
) -> Decision:
    found = TARGETS.parse(target)
    chosen, pins = RULE_SETS.parse(rules), overrides or Overrides()
    plan = make_plan(model, scheme, chosen, pins, fused=found.fused_objection)
    return plan.decisions[-1]


def test_its_features_become_int8_and_nothing_else() -> None:
    found = decided(sampled())

    assert (found.dtype, found.rule, found.activations) == ("int8", "sampled", (0,))
    assert "positions and weights stay float" in found.reason


def test_the_paper_quantizes_weighted_layers_alone() -> None:
    found = decided(sampled(), "paper")

    assert (found.dtype, found.rule) == ("float", "fused-operator")
    assert found.could_be_int8  # so that `plan -v` shows it
    assert decided(sampled(), "paper{without=[fused-operator]}").dtype == "int8"
    assert decided(sampled(), "paper", overrides=TO_INT8).rule == "override"


def test_modules_outside_the_scheme_stay() -> None:
    backbone = QuantScheme.of(("backbone",), MODULES)

    assert decided(sampled(), scheme=backbone).rule == "module"


@pytest.mark.parametrize(
    ("domain", "name", "reason"),
    [
        ("trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", "float32 or float16"),
        ("mmdeploy", "MMCVMultiScaleDeformableAttention", "float32 or float16"),
        ("trt.plugins", "MultiScaleDeformableAttnTRT", "not by QDQ"),
    ],
)
def test_plugins_of_tensorrt_stay_whatever_is_asked(
    domain: str, name: str, reason: str
) -> None:
    model = sampled(domain, name)
    found = decided(model, target="tensorrt")

    assert (found.dtype, found.rule) == ("float", "operator")
    assert reason in found.reason
    with pytest.raises(RecipeError, match=reason):
        decided(model, target="tensorrt", overrides=TO_INT8)


def test_operators_that_declare_nothing_stay() -> None:
    model = net(
        '<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>\n'
        "net (float[3,8,8] x, float[1] a, float[2] c) => (float[3,8,8] y)"
        " { y = me2e.Rotate(x, a, c) }",
        {},
    )

    assert decided(model).reason == "Rotate is not a weighted layer"


def test_constant_features_stay() -> None:
    model = sampled(value=np.ones((1, 63, 3, 8)))

    assert decided(model).reason == "what it samples is constant"


def test_features_in_float16_stay() -> None:
    assert decided(sampled(kind="float16")).rule == "weight"
