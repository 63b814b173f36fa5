import numpy as np
import onnx_ir as ir
import pytest

from tests.targets.onnxruntime.lowered import (
    calibrated,
    drawn,
    feeds,
    kernels,
    ran,
    sqnr_db,
)

CHAIN = """
chain (float[SHAPE8] x, float[8,16] w1, float[16,8] turned, float[16] b1,
       float[16,4] w2, float[4] b2) => (float[SHAPE4] y OUTPUTS) {
    LAYERS
    m2 = MatMul(a, w2)
    y = Add(m2, b2)
}
"""
WEIGHTS = {"w1": (8, 16), "turned": (16, 8), "b1": (16,), "w2": (16, 4), "b2": (4,)}
BIASED = "m1 = MatMul(x, w1)\n s1 = Add(b1, m1)\n a = Relu(s1)"


def chain(layers: str, shape: str = "6,", outputs: str = "") -> ir.Model:
    """Draw a product that ``layers`` write, and one that reads it."""
    text = CHAIN.replace("LAYERS", layers).replace("OUTPUTS", outputs)
    return drawn(text.replace("SHAPE", shape), WEIGHTS)


@pytest.mark.parametrize(
    "layers",
    [
        BIASED,
        "m1 = MatMul(x, w1)\n a = Add(m1, b1)",
        "a = MatMul(x, w1)",
        "m1 = Gemm(x, w1, b1)\n a = Relu(m1)",
        "a = Gemm<transB=1>(x, turned)",
    ],
)
def test_a_product_that_a_layer_alone_reads_is_a_convolution(layers: str) -> None:
    model, fed = chain(layers), feeds(3, x=(6, 8))

    small = calibrated(model, fed)

    found = kernels(small)
    assert (found["QLinearConv"], found["QGemm"]) == (1, 1)
    assert found["Transpose"] == found["Relu"] == 0
    # in, and out of neither: QGemm writes float
    assert (found["QuantizeLinear"], found["DequantizeLinear"]) == (1, 0)
    assert sqnr_db(ran(model, fed)["y"], ran(small, fed)["y"]) > 30


@pytest.mark.parametrize("shape", ["2,3,", "B,3,", "B,T,", "B,2,T,"])
def test_rows_keep_their_dimensions_open_ones_too(shape: str) -> None:
    model = chain(BIASED, shape)
    sizes = [{"B": 2, "T": 3}.get(d) or int(d) for d in shape.split(",")[:-1]]
    fed = feeds(4, x=(*sizes, 8))

    small = calibrated(model, fed)

    want, got = ran(model, fed)["y"], ran(small, fed)["y"]
    assert kernels(small)["QLinearConv"] == 1
    assert got.shape == want.shape
    assert sqnr_db(want, got) > 30


@pytest.mark.parametrize(
    ("layers", "outputs"),
    [
        (BIASED, ", float[6,16] a"),
        (f"{BIASED}\n other = Exp(a)", ", float[6,16] other"),
        (f"{BIASED}\n other = Exp(s1)", ", float[6,16] other"),
    ],
)
def test_a_product_that_is_also_read_in_float_stays_one(
    layers: str, outputs: str
) -> None:
    model, fed = chain(layers, outputs=outputs), feeds(3, x=(6, 8))

    small = calibrated(model, fed)

    assert kernels(small)["QLinearConv"] == 0
    for name, want in ran(model, fed).items():
        assert sqnr_db(want, ran(small, fed)[name]) > 25


def test_a_convolution_rounds_as_its_product_would() -> None:
    fed = feeds(5, x=(6, 8))
    model = chain(BIASED)

    small = calibrated(model, fed)

    # Unoptimized, every node runs in float: only ties may round differently.
    exact, got = ran(small, fed, optimize=False)["y"], ran(small, fed)["y"]
    assert sqnr_db(exact, got) > 45
    assert np.isfinite(got).all()
