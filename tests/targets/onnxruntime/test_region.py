import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.quantization.plan import make_plan
from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.nets import PAPER, net
from tests.targets.onnxruntime.lowered import (
    FULL,
    calibrated,
    feeds,
    kernels,
    lowered,
    ran,
    sqnr_db,
)

NECK = """
neck (float[1,4,8,8] fine, float[1,4,4,4] coarse, float[6,4,1,1] w1, float[6,4,1,1] w2,
      float[6,6,3,3] w3) => (float[1,6,8,8] y)
<float[4] scales = {1, 1, 2, 2}> {
    a = Conv<kernel_shape=[1,1]>(fine, w1)
    b = Conv<kernel_shape=[1,1]>(coarse, w2)
    up = Resize<mode="nearest", coordinate_transformation_mode="asymmetric",
                nearest_mode="floor">(b, "", scales)
    merged = MERGE
    y = Conv<kernel_shape=[3,3], pads=[1,1,1,1]>(merged, w3)
}
"""
FED = feeds(3, fine=(1, 4, 8, 8), coarse=(1, 4, 4, 4))


def neck(merge: str, mode: str = "nearest", channels: int = 6) -> ir.Model:
    generator = np.random.default_rng(0)
    shapes = {"w1": (6, 4, 1, 1), "w2": (6, 4, 1, 1), "w3": (6, channels, 3, 3)}
    text = NECK.replace("MERGE", merge).replace('nearest", c', f'{mode}", c')
    text = text.replace("float[6,6,3,3]", f"float[6,{channels},3,3]")
    weights = {name: generator.standard_normal(size) for name, size in shapes.items()}
    return net(text, weights)


@pytest.mark.parametrize(
    ("merge", "channels", "kernel"),
    [("Add(a, up)", 6, "QLinearAdd"), ("Concat<axis=1>(a, up)", 12, "QLinearConcat")],
)
def test_a_neck_merges_its_levels_in_int8(
    merge: str, channels: int, kernel: str
) -> None:
    found = kernels(calibrated(neck(merge, channels=channels), FED))

    assert found["QLinearConv"] == 3
    assert found[kernel] == 1
    assert found["Resize"] == 1
    # in: the two levels; out: the answer
    assert (found["QuantizeLinear"], found["DequantizeLinear"]) == (2, 1)


def test_what_interpolates_reads_floats_and_so_does_the_sum_behind_it() -> None:
    found = kernels(calibrated(neck("Add(a, up)", mode="linear"), FED))

    assert found["QLinearConv"] == 3
    assert (found["QLinearAdd"], found["Add"]) == (0, 1)


def test_a_sum_that_no_layer_reads_stays_float() -> None:
    model = neck("Add(a, up)")
    last = model.graph[-1]
    merged = last.inputs[0]
    assert merged is not None
    last.replace_input_with(0, model.graph[0].outputs[0])
    model.graph.outputs.append(merged)

    found = kernels(calibrated(model, FED))

    assert (found["QLinearAdd"], found["Add"]) == (0, 1)


BODY = """
body (float[1,4,8,8] fine, float[6,4,1,1] w1, float[6,6,1,1] w2)
    => (float[1,6,8,8] y) {
    c = Conv(fine, w1)
    total = ReduceSum<keepdims=0>(fine)
    seen = Greater(total, total)
    chosen = If (seen) <then_branch = then () => (float[1,6,8,8] t) {
        t = Relu(c)
    }, else_branch = other () => (float[1,6,8,8] e) { e = Conv(fine, w1) }>
    y = Conv(chosen, w2)
}
"""


def test_a_relu_in_a_body_is_no_part_of_the_convolution_before_it() -> None:
    generator = np.random.default_rng(0)
    shapes = {"w1": (6, 4, 1, 1), "w2": (6, 6, 1, 1)}
    weights = {name: generator.standard_normal(size) for name, size in shapes.items()}
    model, fed = net(BODY, weights), feeds(3, fine=(1, 4, 8, 8))

    assert OnnxRuntime().tensors(make_plan(model, FULL, PAPER), model) == (
        "fine",
        "chosen",
        "c",
        "y",
    )
    want, got = ran(model, fed)["y"], ran(calibrated(model, fed), fed)["y"]
    assert sqnr_db(want, got) > 25


def test_a_bias_in_a_body_is_none_of_the_product_before_it() -> None:
    text = """
    body (float[4,8] x, bool seen, float[8,6] w, float[6] b) => (float[4,6] y) {
        m = MatMul(x, w)
        y = If (seen) <then_branch = then () => (float[4,6] t) { t = Add(m, b) },
                       else_branch = other () => (float[4,6] e) { e = MatMul(x, w) }>
    }
    """
    generator = np.random.default_rng(1)
    weights = {"w": generator.standard_normal((8, 6)), "b": np.ones(6)}

    found = lowered(net(text, weights), 4.0)

    assert [n.op_type for n in found.graph if n.op_type in ("Gemm", "MatMul")] == [
        "MatMul"
    ]
