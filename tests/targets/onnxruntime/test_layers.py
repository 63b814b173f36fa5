import numpy as np
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from me2e_compress import graph
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.rules.rule_sets import PaperRules
from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.nets import net
from tests.profiles import scaled
from tests.targets.onnxruntime.lowered import (
    FULL,
    drawn,
    feeds,
    kernels,
    linear,
    lowered,
    measured,
    ran,
    sqnr_db,
)


@settings(max_examples=scaled(20))
@given(seed=st.integers(0, 2**32 - 1), reach=st.floats(0.5, 8.0))
def test_numbers_are_those_of_rounding_both_operands(seed: int, reach: float) -> None:
    model = linear(seed)
    t = feeds(seed, t=(6, 5))["t"]
    fed = {"x": np.zeros((2, 12, 8), np.float32), "t": t}
    turned, bias = (
        graph.array_of(model.graph.initializers[n]) for n in ("turned", "b3")
    )
    assert turned is not None
    assert bias is not None

    got = ran(lowered(model, reach), fed, optimize=False)["z"].astype(np.float64)

    step = np.float32(reach / 127)
    rounded = np.clip(np.rint(t / step), -128, 127).astype(np.float64) * step
    channel = np.abs(turned.astype(np.float32)).max(axis=1, keepdims=True) / 127
    weight = np.rint(turned.astype(np.float32) / channel).astype(np.float64) * channel
    want = rounded @ weight.T + bias.astype(np.float64)
    # the bias is rounded too, to a 127th of a 127th
    np.testing.assert_allclose(got, want, rtol=1e-4, atol=reach / 127 * 0.05)


def test_weights_are_stored_as_int8_once_and_biases_as_int32() -> None:
    text = """
    twice (float[3,4] x, float[4,4] w, float[4] b) => (float[3,4] y) {
        h = Gemm(x, w, b)
        y = Gemm(h, w, b)
    }
    """
    model = lowered(net(text, {"w": np.ones((4, 4)), "b": np.ones(4)}))

    kinds = [
        (value.dtype, len(value.shape))
        for value in model.graph.initializers.values()
        if value.shape is not None and len(value.shape) > 0
    ]
    assert kinds.count((ir.DataType.INT8, 2)) == 1
    assert (ir.DataType.INT32, 1) in kinds
    assert "w" not in model.graph.initializers


def test_a_bias_too_large_for_its_channel_keeps_its_value() -> None:
    text = """
    loud (float[3,4] x, float[4,2] w, float[2] b) => (float[3,2] y) {
        y = Gemm(x, w, b)
    }
    """
    weight = np.ones((4, 2))
    weight[:, 1] = 1e-12
    model = net(text, {"w": weight, "b": np.array([0.5, 3.0])})
    x = np.full((3, 4), 0.25, np.float32)

    got = ran(lowered(model, reach=0.25), {"x": x})["y"]

    np.testing.assert_allclose(got, [[1.5, 3.0]] * 3, rtol=1e-4)


@pytest.mark.parametrize(
    "layer",
    [
        "ConvTranspose<kernel_shape=[2,2]>(r, w, late)",
        "Conv<kernel_shape=[2,2]>(r, w, late)",
    ],
)
def test_layers_without_a_kernel_stay_float(layer: str) -> None:
    text = f"""
    odd (float[1,3,6,6] x, float[3] add, float[3,3,2,2] w) => (float[?,?,?,?] y) {{
        r = Sigmoid(x)
        late = Abs(add)
        y = {layer}
    }}
    """
    model = net(text, {"w": np.ones((3, 3, 2, 2))})

    assert graph.digest(lowered(model)) == graph.digest(model.clone())


@pytest.mark.parametrize("attributes", ["alpha=0.5", "beta=2.0", "transA=1"])
def test_a_gemm_with_factors_stays_float(attributes: str) -> None:
    text = f"""
    odd (float[4,4] x, float[4,4] w, float[4] b) => (float[4,4] y) {{
        y = Gemm<{attributes}>(x, w, b)
    }}
    """
    found = kernels(lowered(net(text, {"w": np.ones((4, 4)), "b": np.ones(4)})))

    assert found["Gemm"] == 1


@pytest.mark.parametrize("shape", ["B,12,8", "B,T,8", "B,T,3,8"])
def test_open_dimensions_stay_open(shape: str) -> None:
    text = f"""
    open (float[{shape}] x, float[8,5] w, float[5] b) => (float[{shape[:-1]}5] y) {{
        m = MatMul(x, w)
        y = Add(m, b)
    }}
    """
    generator = np.random.default_rng(0)
    model = net(text, {"w": generator.random((8, 5)), "b": generator.random(5)})
    sizes = {"B": 3, "T": 4}
    x = generator.random([sizes.get(d) or int(d) for d in shape.split(",")], np.float32)
    small = lowered(model, 1.0)

    want, got = ran(model, {"x": x})["y"], ran(small, {"x": x})["y"]

    assert got.shape == want.shape
    assert sqnr_db(want, got) > 30
    assert kernels(small)["QGemm"] == 1


def test_a_constant_that_lends_a_product_its_columns_is_no_bias() -> None:
    text = """
    lends (float[4,8] x, float[8,1] w, float[5] b) => (float[4,5] y) {
        m = MatMul(x, w)
        y = Add(m, b)
    }
    """
    model = drawn(text, {"w": (8, 1), "b": (5,)})
    plan = make_plan(model, FULL, PaperRules(without=("gemv",)))
    fed = feeds(2, x=(4, 8))

    result = OnnxRuntime().place(
        model, plan, measured(model, OnnxRuntime().tensors(plan, model), fed)
    )

    got, want = ran(result, fed)["y"], ran(model, fed)["y"]
    assert kernels(result)["QGemm"] == 0
    assert got.shape == want.shape
    assert sqnr_db(want, got) > 25
