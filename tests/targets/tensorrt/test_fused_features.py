"""Plugins that take int8 features, and their scale as one more input."""

import importlib.util

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import array_of
from me2e_compress.quantization.plan import make_plan, tensors_of
from me2e_compress.quantization.rules import RULE_SETS
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.session import Session
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.rtx_check import check
from tests.nets import MODULES, net

SPARSE_DRIVE_V2 = """
<ir_version: 9, opset_import: ["" : 17, "sparsedrivev2" : 1]>
net (float[1,30,12] maps, float[1,50,5,1,2] at, float[1,50,5,1,2,3] shares)
    => (float[1,50,12] y)
<int32[1,2,2] sizes = {4, 6, 2, 3}, int32[1,2] starts = {0, 24}> {
    ["/head/sampled"] y =
        sparsedrivev2.DeformableAggregation(maps, sizes, starts, at, shares)
}
"""


def placed() -> tuple[ir.Model, ir.Model]:
    model, target = net(SPARSE_DRIVE_V2, {}), TensorRT()
    scheme, rules = QuantScheme.of(("head",), MODULES), RULE_SETS.parse("safe")
    plan = make_plan(model, scheme, rules, fused=target.fused_objection)
    ends = dict.fromkeys(tensors_of(plan, model), (-3.0, 2.0))
    return model, target.place(model, plan, Ranges(ends, "max-min", 1, "", ""))


def test_it_gets_integers_and_a_scale_for_every_channel() -> None:
    _, small = placed()

    assert [node.op_type for node in small.graph] == [
        "QuantizeLinear",
        "DeformableAggregation",
    ]
    maps, *_, scales = small.graph[1].inputs
    assert maps is not None
    assert maps.dtype == ir.DataType.INT8
    numbers = array_of(scales)
    assert numbers is not None
    assert np.allclose(numbers.astype(np.float64), np.full(12, 3 / 127))
    assert TensorRT().lint(small) == ()


def test_it_computes_the_same_to_rounding() -> None:
    model, small = placed()
    random = np.random.default_rng(0)
    fed = {
        "maps": random.uniform(-3, 2, (1, 30, 12)).astype(np.float32),
        "at": random.uniform(0, 1, (1, 50, 5, 1, 2)).astype(np.float32),
        "shares": random.uniform(0, 1, (1, 50, 5, 1, 2, 3)).astype(np.float32),
    }

    want, got = (
        Session(each, threads=1).run(fed)["y"].astype(np.float64)
        for each in (model, small)
    )

    assert 0 < np.abs(got - want).max() < 0.02 * np.abs(want).max()


@pytest.mark.skipif(
    importlib.util.find_spec("tensorrt_rtx") is None, reason="extra trt-check"
)
def test_tensorrts_parser_takes_all_but_the_plugin() -> None:
    found = check(placed()[1], build=False)

    assert found.passed
    assert found.cut == ("/head/sampled",)
