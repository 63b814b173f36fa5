"""Averages between int8 layers: their own grid, their readers, their kernels."""

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.graph.nodes import scalar_of
from me2e_compress.quantization.plan import make_plan
from me2e_compress.targets.onnxruntime import OnnxRuntime
from me2e_compress.targets.onnxruntime.convert import convert, unranged
from me2e_compress.targets.tensorrt import TensorRT
from tests.support.nets import FULL, PAPER, drawn, net
from tests.targets.onnxruntime.lowered import (
    calibrated,
    feeds,
    kernels,
    measured,
    ran,
    sqnr_db,
)

AVERAGED = """
<ir_version: 9, opset_import: ["" : 19]>
m (float[3,4,16,16] x, float[8,4,3,3] w, float[8] b, float[8,8] l, float[8,8,1,1] k)
    => (OUTPUT) <int64[2] flat = {3, -1}> {
    c = Conv<pads=[1,1,1,1]>(x, w, b)
    r = Relu(c)
    BODY
}
"""
GLOBAL = "p = GlobalAveragePool(r)"
PAD = "kernel_shape=[3,3], strides=[2,2], pads=[1,1,1,1]"
WINDOWS = f"p = AveragePool<{PAD}>(r)"
X = feeds(2, x=(3, 4, 16, 16))


IMAGE, FLAT = "float[3,8,h,w] y", "float[3,8] y"


def averaged(body: str, output: str) -> ir.Model:
    """Sparse features behind a ReLU, of which some are averaged."""
    text = AVERAGED.replace("BODY", body).replace("OUTPUT", output)
    rng = np.random.default_rng(0)
    shapes = {"w": (8, 4, 3, 3), "l": (8, 8), "k": (8, 8, 1, 1)}
    weights = {name: rng.standard_normal(size) for name, size in shapes.items()}
    return net(text, {**weights, "b": np.full(8, -12.0)})


def ranged(model: ir.Model) -> tuple[str, ...]:
    return OnnxRuntime().tensors(make_plan(model, FULL, PAPER), model)


def losses_db(model: ir.Model) -> tuple[float, float]:
    """What int8 loses of y, here and for TensorRT, as the nodes say."""
    plan, want = make_plan(model, FULL, PAPER), ran(model, X)["y"]
    targets = OnnxRuntime(), TensorRT()
    placed = [
        each.place(model, plan, measured(model, each.tensors(plan, model), X))
        for each in targets
    ]
    here, there = (sqnr_db(want, ran(each, X, optimize=False)["y"]) for each in placed)
    return here, there


HEADS = [
    (f"{GLOBAL} y = Conv(p, k)", IMAGE, "QLinearGlobalAveragePool"),
    (f"{WINDOWS} y = Conv(p, k)", IMAGE, "QLinearAveragePool"),
    (f"{GLOBAL} f = Flatten(p) y = Gemm(f, l)", FLAT, "QLinearGlobalAveragePool"),
    (
        f"{GLOBAL} f = Reshape(p, flat) y = MatMul(f, l)",
        FLAT,
        "QLinearGlobalAveragePool",
    ),
    (
        f"{WINDOWS} f = Transpose<perm=[0,2,3,1]>(p) y = MatMul(f, l)",
        "float[3,h,w,8] y",
        "QLinearAveragePool",
    ),
    (
        f"{WINDOWS} q = GlobalAveragePool(p) y = Conv(q, k)",
        IMAGE,
        "QLinearGlobalAveragePool",
    ),
    (
        f"{WINDOWS} d = Conv<strides=[2,2]>(r, k) s = Add(p, d) y = Conv(s, k)",
        IMAGE,
        "QLinearAveragePool",
    ),
    # read as float: not rounded
    (f"{GLOBAL} y = Tanh(p)", IMAGE, "GlobalAveragePool"),
    (
        f"{GLOBAL} f = Flatten(p) t = Tanh(f) g = Gemm(f, l) y = Mul(g, t)",
        "float y",
        "GlobalAveragePool",
    ),
    (f"{WINDOWS} y = Conv(p, k)", f"{IMAGE}, float[3,8,h,w] p", "AveragePool"),
    (f"{WINDOWS} y = Sigmoid(p)", IMAGE, "AveragePool"),
]


@pytest.mark.parametrize(("body", "output", "kernel"), HEADS)
def test_an_average_is_int8_on_its_own_grid_unless_it_is_read_as_float(
    body: str, output: str, kernel: str
) -> None:
    model = averaged(body, output)

    assert "p" in ranged(model) or not kernel.startswith("QLinear")
    assert kernels(calibrated(model, X))[kernel] == 1
    here, there = losses_db(model)
    assert here > there - 6


@pytest.mark.parametrize(
    "options",
    [
        "kernel_shape=[3,3], dilations=[2,2]",
        "kernel_shape=[3,3], dilations=[1,1]",
        "kernel_shape=[4,4], strides=[3,3], ceil_mode=1, count_include_pad=1",
        f"{PAD.replace('2,2', '3,3')}, ceil_mode=1, count_include_pad=1",
    ],
)
@pytest.mark.parametrize(
    ("reader", "output"),
    [
        ("z = Relu(p) y = Conv(z, k)", IMAGE),
        ("t = Transpose<perm=[0,2,3,1]>(p) y = MatMul(t, l)", "float[3,h,w,8] y"),
    ],
)
def test_an_average_without_a_right_kernel_stays_float(
    options: str, reader: str, output: str
) -> None:
    """onnxruntime would refuse the graph, or divide by places beyond the padding."""
    model = averaged(f"p = AveragePool<{options}>(r) {reader}", output)
    small = calibrated(model, X)

    onnx.checker.check_model(ir.to_proto(small), full_check=True)
    assert kernels(small)["AveragePool"] == 1
    assert ran(small, X)["y"].shape == ran(model, X)["y"].shape
    here, there = losses_db(model)
    assert here > there - 6


SHARED = f"o = Conv(r, k) {GLOBAL} f = Flatten(p) y = Gemm(f, l)"


def test_a_tensorrt_graph_has_the_range_of_an_average_behind_its_layout() -> None:
    model = averaged(SHARED, f"{FLAT}, float[3,8,h,w] o")
    plan = make_plan(model, FULL, PAPER)
    ranges = measured(model, TensorRT().tensors(plan, model), X)
    source = TensorRT().place(model, plan, ranges)

    assert set(unranged(source)) == {"o"}
    small = convert(source, measured(source, ("o",), X))
    step = scalar_of(small.graph.initializers["f_scale"])
    assert step == pytest.approx(ranges.tensors["f"][1] / 255)
    assert kernels(small)["QLinearGlobalAveragePool"] == 1


ROW = """
m (float[B,6,1,1] x, float[5,6,1,1] w, float[5] b, float[3,5,1,1] v)
    => (float[B,n,1,1] y) { BODY }
"""
FOUR = feeds(3, x=(4, 6, 1, 1))


def row(body: str, text: str = ROW) -> ir.Model:
    shapes = {"w": (5, 6, 1, 1), "b": (5,), "v": (3, 5, 1, 1)}
    if "1,1,1" in text:
        shapes = {
            name: (*size, 1)[: 5 if len(size) > 1 else 1]
            for name, size in shapes.items()
        }
    return drawn(text.replace("BODY", body), shapes)


@pytest.mark.parametrize(
    ("body", "products", "convolutions"),
    [
        ("y = Conv(x, w, b)", 1, 0),
        ("y = Conv(x, w)", 1, 0),
        ("c = Conv(x, w, b) y = Relu(c)", 1, 0),
        ("c = Conv(x, w, b) r = Relu(c) d = Conv(r, v) y = Sigmoid(d)", 1, 1),
        ("c = Conv(x, w) d = Conv(c, v) e = Sigmoid(c) y = Concat<axis=1>(d, e)", 2, 0),
    ],
)
@pytest.mark.parametrize("text", [ROW, ROW.replace("1,1]", "1,1,1]")])
def test_a_convolution_of_one_pixel_may_write_float(
    body: str, products: int, convolutions: int, text: str
) -> None:
    model = row(body, text)
    fed = feeds(3, x=(4, 6, *([1] * (text.count(",1") // 4))))
    small = calibrated(model, fed)
    found = kernels(small)

    onnx.checker.check_model(ir.to_proto(small), full_check=True)
    assert "y" not in ranged(model)
    assert found["QGemm"] == products
    assert found["QLinearConv"] == convolutions
    want, got = ran(model, fed)["y"], ran(small, fed, optimize=False)["y"]
    assert got.shape == want.shape
    assert sqnr_db(want, got) > 30


@pytest.mark.parametrize(
    ("options", "shape"), [("pads=[1,1,1,1]", (5, 6, 1, 1)), ("group=2", (6, 3, 1, 1))]
)
def test_other_convolutions_of_a_pixel_write_uint8(
    options: str, shape: tuple[int, ...]
) -> None:
    text = ROW.replace("w, float[5] b, float[3,5,1,1] v", "w")
    text = text.replace("float[5,6,1,1]", f"float{list(shape)}").replace(
        "float[B,n,1,1]", "float[B,n,h,w]"
    )
    model = drawn(text.replace("BODY", f"y = Conv<{options}>(x, w)"), {"w": shape})

    assert ranged(model) == ("x", "y")
    assert kernels(calibrated(model, FOUR))["QLinearConv"] == 1
