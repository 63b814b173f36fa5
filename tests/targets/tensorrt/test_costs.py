"""What a GPU is predicted to be faster with."""

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.quantization.plan import Decision, make_plan
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.targets import TARGETS
from tests.nets import MODULES, net

RULES = RULE_SETS.parse("paper{extra=[cost]}")
HEAD = QuantScheme.of(("head",), MODULES)


def product() -> ir.Model:
    """SparseDriveV2's weights_fc, of which int8 made an engine 2.8 ms slower."""
    return net(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "p (float[3072,256] x, float[256,16000] w) => (float[3072,16000] y)"
        " { y = MatMul(x, w) }",
        {"w": np.ones((256, 16000))},
    )


def convolution() -> ir.Model:
    return net(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "c (float[3,256,16,64] x, float[256,256,3,3] w) => (float[3,256,14,62] y)"
        " { y = Conv(x, w) }",
        {"w": np.ones((256, 256, 3, 3))},
    )


def decided(model: ir.Model, target: str) -> Decision:
    plan = make_plan(model, HEAD, RULES, costs=TARGETS.parse(target).costs)
    return plan.decisions[0]


def test_a_product_with_a_large_answer_stays_float_on_orin() -> None:
    decision = decided(product(), "tensorrt{machine=orin}")

    assert (decision.dtype, decision.rule) == ("float", "cost")
    assert decision.reason.endswith("on TensorRT on Orin, as predicted")


def test_a_convolution_of_many_channels_is_int8_there() -> None:
    assert decided(convolution(), "tensorrt{machine=orin}").dtype == "int8"


def test_without_a_machine_nothing_is_predicted() -> None:
    assert decided(product(), "tensorrt").dtype == "int8"


def test_no_such_machine() -> None:
    with pytest.raises(RecipeError, match="no machine thor; there are orin"):
        TARGETS.parse("tensorrt{machine=thor}")
