import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import PreconditionError
from me2e_compress.quantization.plan import make_plan
from me2e_compress.targets.onnxruntime.convert import convert, unranged
from me2e_compress.targets.tensorrt import TensorRT
from tests.support.nets import FULL, PAPER, drawn, parsed
from tests.targets.onnxruntime.lowered import (
    IMAGE,
    TOKENS,
    Feeds,
    block,
    calibrated,
    feeds,
    kernels,
    linear,
    measured,
    ran,
    sqnr_db,
)

PAIRED = """
<ir_version: 9, opset_import: ["" : 19]>
foreign (float[4,6] x) => (float[4,3] y)
<float s = {0.02}, int8 z = {0}, float[3] ws = {0.01, 0.02, 0.03},
 int8[3] wz = {0, 0, 0},
 float[6,3] w = {0.1, 0.2, 0.3, 0.4, 0.5, 0.6, 0.7, 0.8, 0.9,
                 1.0, 1.1, 1.2, -0.1, -0.2, -0.3, 1.27, 2.54, 3.81}>
{
    xq = QuantizeLinear(x, s, z)
    xd = DequantizeLinear(xq, s, z)
    wq = QuantizeLinear<axis=1>(w, ws, wz)
    wd = DequantizeLinear<axis=1>(wq, ws, wz)
    y = MatMul(xd, wd)
}
"""
"""Weights in float behind a pair, as ModelOpt writes them."""


def placed(model: ir.Model, fed: Feeds) -> ir.Model:
    plan = make_plan(model, FULL, PAPER)
    ranges = measured(model, TensorRT().tensors(plan, model), fed)
    return TensorRT().place(model, plan, ranges)


def converted(source: ir.Model, fed: Feeds) -> ir.Model:
    missing = unranged(source)
    return convert(source, measured(source, missing, fed) if missing else None)


@pytest.mark.parametrize(
    ("model", "fed"), [(block(), IMAGE), (linear(), TOKENS)], ids=["block", "linear"]
)
def test_a_tensorrt_graph_runs_with_the_kernels_of_a_lowered_plan(
    model: ir.Model, fed: Feeds
) -> None:
    found = converted(placed(model, fed), fed)

    assert kernels(found) == kernels(calibrated(model, fed))
    want, got = ran(model, fed), ran(found, fed)
    assert all(sqnr_db(want[name], got[name]) > 25 for name in want)


def test_only_what_convolutions_answer_is_left_to_calibrate() -> None:
    assert set(unranged(placed(block(), IMAGE))) == {"a1", "z3", "y"}
    assert unranged(placed(linear(), TOKENS)) == ()


def test_weights_behind_a_pair_become_stored_integers() -> None:
    source = parsed(PAIRED)
    small = convert(source)

    stored = [
        graph.array_of(value)
        for value in small.graph.initializers.values()
        if value.dtype == ir.DataType.INT8 and value.shape is not None
        if len(value.shape) == 2
    ]
    weight = graph.array_of(source.graph.initializers["w"])
    assert weight is not None
    steps = weight.astype(np.float32) / np.array([0.01, 0.02, 0.03], np.float32)
    assert len(stored) == 1
    np.testing.assert_array_equal(stored[0], np.rint(steps).astype(np.int8))
    assert kernels(small)["MatMulIntegerToFloat"] == 1


def test_an_output_behind_a_pair_stays_an_output() -> None:
    text = PAIRED.replace(
        "y = MatMul(xd, wd)",
        """m = MatMul(xd, wd)
    yq = QuantizeLinear(m, s, z)
    y = DequantizeLinear(yq, s, z)""",
    )
    x = np.random.default_rng(0).uniform(-0.3, 0.3, (4, 6)).astype(np.float32)
    source = parsed(text)

    result = convert(source)

    assert [value.name for value in result.graph.outputs] == ["y"]
    assert sqnr_db(ran(source, {"x": x})["y"], ran(result, {"x": x})["y"]) > 30


def test_a_bias_stored_as_integers_is_read() -> None:
    text = PAIRED.replace(
        "float s = {0.02}",
        "float s = {0.02}, int32[3] b = {5000, -5000, 0},"
        " float[3] bs = {0.0002, 0.0004, 0.0006}, int32[3] bz = {0, 0, 0}",
    ).replace(
        "y = MatMul(xd, wd)",
        """bd = DequantizeLinear<axis=0>(b, bs, bz)
    y = Gemm(xd, wd, bd)""",
    )
    x = np.zeros((4, 6), np.float32)

    got = ran(convert(parsed(text)), {"x": x})["y"]

    np.testing.assert_allclose(got, [[1.0, -2.0, 0.0]] * 4, atol=1e-6)


SIX = (("axis=1>(wq", "axis=0>(wq"),
       ("float[3] ws = {0.01, 0.02, 0.03}", "float[6] ws = {1., 1., 1., 1., 1., 1.}"),
       ("int8[3] wz = {0, 0, 0}", "int8[6] wz = {0, 0, 0, 0, 0, 0}"))  # fmt: skip


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ([("int8 z = {0}", "int8 z = {3}")], "zero point 3: only symmetric int8"),
        ([("int8 z = {0}", "uint8 z = {128}")], "quantizes to uint8: only symmetric"),
        ([("float s = {0.02}", "float16 s = {9503}")], "float16 scale, expected float"),
        (
            [("axis=1>(w,", "axis=0>(w,"), *SIX],
            r"scales of shape \[6\] along axis 0, expected one",
        ),
        (
            [
                *(("(x, s, z)", "<axis=0>(x, s, z)"), ("(xq, s", "<axis=0>(xq, s")),
                ("float s = {0.02}", "float[4] s = {1., 1., 1., 1.}"),
                ("int8 z = {0}", "int8[4] z = {0, 0, 0, 0}"),
            ],
            r"4 scales: .* take one",
        ),
    ],
)
def test_other_grids_are_refused(changes: list[tuple[str, str]], message: str) -> None:
    text = PAIRED
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)

    with pytest.raises(PreconditionError, match=message):
        convert(parsed(text))


def test_a_float_graph_is_refused() -> None:
    with pytest.raises(PreconditionError, match="no quantized activation"):
        convert(block())


BATCHED = """
batched (float[3,4,32] x, float[%s] w) => (float[3,4,16] y) { y = MatMul(x, w) }
"""


@pytest.mark.parametrize(("size", "int8"), [((1, 32, 16), 1), ((3, 32, 16), 0)])
def test_products_by_batches_of_matrices_are_lowered_as_far_as_kernels_go(
    size: tuple[int, ...], int8: int
) -> None:
    text = BATCHED % ",".join(map(str, size))
    model, fed = drawn(text, {"w": size}), feeds(4, x=(3, 4, 32))
    source = placed(model, fed)

    result = converted(source, fed)

    assert kernels(result)["MatMulIntegerToFloat"] == int8
    assert sqnr_db(ran(model, fed)["y"], ran(result, fed)["y"]) > 30


def test_a_matrix_with_scales_along_its_rows_stays_float() -> None:
    text = (
        PAIRED.replace(
            "float[4,6] x) => (float[4,3] y)", "float[1,4,6] x) => (float[1,4,3] y)"
        )
        .replace("float[6,3] w", "float[1,6,3] w")
        .replace(*SIX[1])
        .replace(*SIX[2])
    )
    source = parsed(text)
    x = np.random.default_rng(0).uniform(-0.3, 0.3, (1, 4, 6)).astype(np.float32)

    result = convert(source)

    assert kernels(result)["MatMul"] == 1
    want, got = ran(source, {"x": x}, optimize=False), ran(result, {"x": x})
    assert sqnr_db(want["y"], got["y"]) > 20
