"""FP8 pairs and int4 weights by block: TensorRT takes both."""

from collections.abc import Sequence

import numpy as np
import onnx
import onnx_ir as ir
import pytest
from onnx import TensorProto, helper, numpy_helper

from me2e_compress.targets.tensorrt import TensorRT

FP8, INT4 = TensorProto.FLOAT8E4M3FN, TensorProto.INT4
ZERO = helper.make_tensor("z", FP8, [], bytes(1), raw=True)


def rules_of(
    nodes: Sequence[onnx.NodeProto], weights: Sequence[onnx.TensorProto]
) -> set[str]:
    ports = [helper.make_tensor_value_info(n, 1, [4, 32]) for n in "xy"]
    graph = helper.make_graph(nodes, "g", ports[:1], ports[1:], weights)
    proto = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 21)])
    onnx.checker.check_model(proto, full_check=True)
    model = ir.serde.deserialize_model(proto)
    return {each.rule for each in TensorRT().lint(model)} - {"opset"}


def test_fp8_pairs_of_activation_and_weight_are_taken() -> None:
    w = helper.make_tensor("w", FP8, [32, 32], bytes(range(64)) * 16, raw=True)
    scale = numpy_helper.from_array(np.array(0.01, np.float32), "s")
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"], name="q"),
        helper.make_node("DequantizeLinear", ["q", "s", "z"], ["d"], name="d"),
        helper.make_node("DequantizeLinear", ["w", "s", "z"], ["wd"], name="wd"),
        helper.make_node("MatMul", ["d", "wd"], ["y"], name="product"),
    ]
    assert rules_of(nodes, [w, scale, ZERO]) == set()


@pytest.mark.parametrize(
    ("kind", "rules"),
    [(INT4, set()), (TensorProto.INT8, {"channel-scale", "half-quantized"})],
)
def test_int4_weights_alone_have_scales_by_block(kind: int, rules: set[str]) -> None:
    values = [place % 15 - 7 for place in range(1024)]
    w = helper.make_tensor("w", kind, [32, 32], values)
    scale = numpy_helper.from_array(np.full((2, 32), 0.01, np.float32), "s")
    nodes = [
        helper.make_node(
            "DequantizeLinear", ["w", "s"], ["wd"], name="wd", axis=0, block_size=16
        ),
        helper.make_node("MatMul", ["x", "wd"], ["y"], name="product"),
    ]
    assert rules_of(nodes, [w, scale]) == rules


def test_an_activation_in_int4_is_refused() -> None:
    scale = numpy_helper.from_array(np.array(0.01, np.float32), "s")
    zero = helper.make_tensor("z", INT4, [], [0])
    nodes = [
        helper.make_node("QuantizeLinear", ["x", "s", "z"], ["q"], name="q"),
        helper.make_node("DequantizeLinear", ["q", "s", "z"], ["y"], name="d"),
    ]
    assert "quantized-type" in rules_of(nodes, [scale, zero])
