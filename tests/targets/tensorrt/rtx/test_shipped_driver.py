"""The driver that ships, in every scheme, as TensorRT gets it."""

import importlib.util

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph.modules import map_of
from me2e_compress.manager import PassManager, recipe
from me2e_compress.passes import Context
from me2e_compress.quantization.plan import make_plan, stamp_plan, tensors_of
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.shipped.drivers import shipped
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import check

SCHEMES = ("feature-ext", "prediction", "full")


@pytest.fixture(scope="module")
def driver() -> ir.Model:
    """After the exact passes, unverified: that is asked elsewhere."""
    loaded = graph.load(shipped("highway"))
    context = Context(map_of(loaded, None))
    model = PassManager(recipe.load("exact"), verify_frames=0).run(loaded, context)
    graph.infer_shapes(model.model)
    return model.model


def quantized(model: ir.Model, scheme: str, rules: str) -> ir.Model:
    """Place int8; what is built does not hang on the values of the scales."""
    chosen = QuantScheme.named(scheme, map_of(model, None))
    plan = make_plan(model, chosen, RULE_SETS.parse(rules))
    ranges = dict.fromkeys(tensors_of(plan, model), (-3.0, 3.0))
    placed = TensorRT().place(model, plan, Ranges(ranges, "max-min", 1, "", ""))
    stamp_plan(placed, plan)
    return placed


@pytest.mark.parametrize("rules", ["safe", "paper"])
@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_passes_the_lint(
    driver: ir.Model, scheme: str, rules: str
) -> None:
    placed = quantized(driver, scheme, rules)

    assert TensorRT(version="10.7").lint(placed) == ()
    assert any(node.op_type == "QuantizeLinear" for node in placed.graph)


@pytest.mark.slow
@pytest.mark.skipif(
    importlib.util.find_spec("tensorrt_rtx") is None, reason="extra trt-check"
)
@pytest.mark.parametrize("scheme", SCHEMES)
def test_every_scheme_is_built_with_int8_convolutions(
    driver: ir.Model, scheme: str
) -> None:
    found = check(quantized(driver, scheme, "paper"))

    assert found.passed, found.errors or found.missing
    assert (found.cut, found.missing) == ((), ())
