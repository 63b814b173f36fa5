import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import FramesError
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.graph import provenance
from me2e_compress.quantization.plan import make_plan
from me2e_compress.runtime.optimized import optimize
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.convert import int8_layers
from tests.support.nets import FULL, PAPER, conv_attention, drawn, placed
from tests.targets.onnxruntime.lowered import (
    IMAGE,
    TOKENS,
    block,
    calibrated,
    feeds,
    kernels,
    linear,
    lowered,
    ran,
    sqnr_db,
)


def producer(model: ir.Model, name: str) -> ir.Node:
    (node,) = (n for n in model.graph if any(o.name == name for o in n.outputs))
    return node


def test_a_residual_block_runs_in_int8_from_end_to_end() -> None:
    found = kernels(calibrated(block(), IMAGE))

    assert found["QLinearConv"] == 4
    assert found["QLinearAdd"] == 1
    assert found["QuantizeLinear"] == 1
    assert not {"Conv", "FusedConv", "Add", "Relu", "MaxPool"} & set(found)


@pytest.mark.parametrize("seed", range(3))
def test_the_lowered_graph_stays_close_and_kernels_answer_its_pairs(seed: int) -> None:
    for model, fed in ((block(seed), IMAGE), (linear(seed), TOKENS)):
        small = calibrated(model, fed)
        want, got = ran(model, fed), ran(small, fed)
        said = ran(small, fed, optimize=False)
        # 8 bits are about 45 dB a layer of normal numbers; four in a row cost some
        assert all(25 < sqnr_db(want[name], got[name]) < 60 for name in want)
        assert all(sqnr_db(said[name], got[name]) > 35 for name in want)


def test_attention_products_read_floats() -> None:
    model = lowered(conv_attention())

    for name in ("scores", "mixed"):
        read = [str(value.name) for value in producer(model, name).inputs if value]
        assert read == [
            str(v.name) for v in producer(conv_attention(), name).inputs if v
        ]
    assert kernels(model)["QLinearConv"] == 1
    source = conv_attention()
    found = OnnxRuntime().kept_float(make_plan(source, FULL, PAPER), source)
    assert [each.node for each in found] == ["/head/QK", "/head/AV"]


def test_sums_around_linear_layers_stay_float_and_read_what_is_unrounded() -> None:
    small = calibrated(linear(), TOKENS)

    inputs = producer(small, "doubled").inputs
    assert [str(value.name) for value in inputs if value] == ["x", "y"]
    assert kernels(small)["QLinearAdd"] == 0


@pytest.mark.parametrize(
    ("rules", "ends", "signed"),
    [
        ("paper{balance=true}", (-2.55, 2.55), (2.55 / 127, 128)),
        ("paper{balance=true}", (-1.28, 2.55), (2.55 / 127, 128)),
        # one side is twice the other or more: only rules `paper` stay symmetric
        ("paper{balance=true}", (-0.5, 2.05), (0.01, 50)),
        ("paper{balance=true}", (-2.55, -1.0), (0.01, 255)),
        ("paper", (-0.5, 2.55), (2.55 / 127, 128)),
    ],
)
def test_a_grid_spans_the_range(
    rules: str, ends: tuple[float, float], signed: tuple[float, int]
) -> None:
    made = {}
    for node in placed(block(), "onnxruntime", rules, ends=ends).graph:
        if node.op_type == "QuantizeLinear" and node.inputs[0] is not None:
            grid = map(graph.array_of, node.inputs[1:])
            made[node.inputs[0].name] = [np.asarray(each).item() for each in grid]

    # an output keeps its name on what is dequantized
    for name in ("x", "z3", "y_replaced"):
        assert made[name] == [np.float32(signed[0]), signed[1]]
    most = max(0.0, ends[1] if "balance" in rules else 2.55)
    for name in ("a1", "p1", "a2", "a3"):  # never negative
        assert made[name] == [np.float32(most / 255) or 1, 0]


def test_what_only_moves_elements_shares_the_grid_of_what_it_moves() -> None:
    model = block()

    assert OnnxRuntime().tensors(make_plan(model, FULL, PAPER), model) == (
        "x", "a1", "a2", "a3", "z3", "y",
    )  # fmt: skip


@pytest.mark.parametrize("model", [block(), linear(), conv_attention()])
def test_the_result_is_a_valid_graph_and_the_source_untouched(model: ir.Model) -> None:
    before = graph.digest(model)

    result = lowered(model)

    onnx.checker.check_model(ir.to_proto(result), full_check=True)
    assert graph.digest(model) == before
    assert graph.interface(result) == graph.interface(model)
    assert OnnxRuntime().lint(result) == ()
    assert not provenance.missing(result)
    fresh = [n for n in result.graph if n.op_type.endswith("quantizeLinear")]
    pasts = [provenance.read(node) for node in fresh]
    assert all(past and past.passes == ("quantize-int8",) for past in pasts)


def test_a_missing_range_is_named() -> None:
    model = block()
    plan = make_plan(model, FULL, PAPER)
    some = Ranges({"x": (-1.0, 1.0), "a1": (0.0, 1.0)}, "max-min", 1, "", "")

    with pytest.raises(FramesError, match=r"4 tensors have no range.* a2.*calibrated"):
        OnnxRuntime().place(model, plan, some)


def test_what_is_new_is_called_like_nothing_that_is_there() -> None:
    text = """
    clash (float[1,4,8,8] x, float[8,4,1,1] w, float[8,8,1,1] x_float)
        => (float[1,8,8,8] y) {
        x_scale = Conv(x, w)
        x_uint8 = Relu(x_scale)
        y = Conv(x_uint8, x_float)
    }
    """
    model = drawn(text, {"w": (8, 4, 1, 1), "x_float": (8, 8, 1, 1)})
    fed = feeds(2, x=(1, 4, 8, 8))

    result = calibrated(model, fed)

    onnx.checker.check_model(ir.to_proto(result), full_check=True)
    assert sqnr_db(ran(model, fed)["y"], ran(result, fed)["y"]) > 30


KEPT = """
kept (float[1,8,4,4] x, float[8,8,1,1] w, float[8,8,2,2] up, float[8,4,4] many)
    => (float[1,8,4,4] s, float[1,8,8,8] u, float[1,8,4,4] m) {
    c = Conv(x, w)
    s = Add(c, x)
    u = ConvTranspose<kernel_shape=[2,2], strides=[2,2]>(x, up)
    m = MatMul(x, many)
}
"""


def test_what_the_kernels_do_not_take_is_listed_with_the_reason() -> None:
    model = drawn(KEPT, {"w": (8, 8, 1, 1), "up": (8, 8, 2, 2), "many": (8, 4, 4)})
    plan = make_plan(model, FULL, PAPER)

    found = {each.output: each.reason for each in OnnxRuntime().kept_float(plan, model)}

    assert found == {
        "s": "a sum that no int8 kernel reads, or of which none gives a side",
        "u": "there is no int8 kernel for ConvTranspose",
        "m": "the weight is a batch of matrices",
    }
    assert len(int8_layers(lowered(model))) == len(plan.chosen) - len(found)


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
    shapes = {"w1": (6, 4, 1, 1), "w2": (6, 4, 1, 1), "w3": (6, channels, 3, 3)}
    text = NECK.replace("MERGE", merge).replace('nearest", c', f'{mode}", c')
    text = text.replace("float[6,6,3,3]", f"float[6,{channels},3,3]")
    return drawn(text, shapes)


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
    if kernel == "QLinearAdd":  # what interpolates reads floats, and so does its sum
        found = kernels(calibrated(neck(merge, mode="linear"), FED))
        assert [found[each] for each in ("QLinearConv", kernel, "Add")] == [3, 0, 1]


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
    model = drawn(BODY, {"w1": (6, 4, 1, 1), "w2": (6, 6, 1, 1)})
    fed = feeds(3, fine=(1, 4, 8, 8))

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
    found = lowered(drawn(text, {"w": (8, 6), "b": (6,)}), 4.0)

    assert [n.op_type for n in found.graph if n.op_type in ("Gemm", "MatMul")] == [
        "MatMul"
    ]


@pytest.mark.parametrize("read", ["p", "m"])
def test_a_pool_of_floats_stays_in_front_of_its_quantization(read: str) -> None:
    """Else onnxruntime pools uint8 that no QLinearConv wrote, ten times as slowly."""
    text = f"""
    stem (float[1,4,8,8] x, float[8,4,1,1] w) => (float[1,8,4,4] y) {{
        p = MaxPool<kernel_shape=[2,2], strides=[2,2]>(x)
        m = Transpose<perm=[0,1,3,2]>(p)
        y = Conv({read}, w)
    }}
    """
    small = calibrated(drawn(text, {"w": (8, 4, 1, 1)}), feeds(2, x=(1, 4, 8, 8)))

    (pool,) = (n for n in optimize(small).graph if n.op_type.endswith("MaxPool"))
    assert pool.inputs[0] is not None
    assert pool.inputs[0].name == "x"
