"""Quantized Gemms that are read in float, as our sessions open them."""

from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnxruntime as ort
import pytest

from me2e_compress.runtime.int8_values import write_float_products
from me2e_compress.runtime.optimized import optimized
from me2e_compress.runtime.providers import CPU
from me2e_compress.runtime.runnable import runnable
from me2e_compress.runtime.session import Session

LAYER = """
<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>
layer (float[2,3,8] x, int8[8,5] w, float[5] ws, int8[5] wz, int32[5] b, float[5] bs)
    => (float[6,5] y)
<float s = {0.031}, uint8 z = {120}, int8 signed = {0}, int64[2] rows = {-1, 8},
 float[2,2] turns = {1, 2, 3, 4}> {
    q = QuantizeLinear(x, s, z)
    d = DequantizeLinear(q, s, z)
    r = Reshape(d, rows)
    wf = DequantizeLinear<axis=1>(w, ws, wz)
    bf = DequantizeLinear<axis=0>(b, bs)
    PRODUCT
}
"""
PRODUCT = "y = Gemm(r, wf, bf)"
INVERTED = f"{PRODUCT}  inverted = me2e.Inverse(turns)"


def layer(product: str = PRODUCT, seed: int = 0) -> ir.Model:
    """Draw the weights of the layer."""
    random = np.random.default_rng(seed)
    scales = random.uniform(0.001, 0.02, 5).astype(np.float32)
    arrays: dict[str, npt.NDArray[Any]] = {
        "w": random.integers(-127, 128, (8, 5)).astype(np.int8),
        "ws": scales,
        "wz": np.zeros(5, np.int8),
        "b": random.integers(-9999, 9999, 5).astype(np.int32),
        "bs": scales * np.float32(0.031),
    }
    model = ir.from_onnx_text(LAYER.replace("PRODUCT", product))
    for value in list(model.graph.inputs):
        if str(value.name) in arrays:
            model.graph.inputs.remove(value)
            value.const_value = ir.tensor(arrays[str(value.name)], name=value.name)
            model.graph.register_initializer(value)
    return model


def drawn(seed: int = 1) -> dict[str, npt.NDArray[np.float32]]:
    numbers = np.random.default_rng(seed).standard_normal((2, 3, 8))
    return {"x": numbers.astype(np.float32)}


def ran(
    model: ir.Model, fed: dict[str, npt.NDArray[np.float32]], *, optimize: bool = True
) -> npt.NDArray[np.float64]:
    session = Session(model, threads=1, optimize=optimize, int8_kernels=True)
    return session.run(fed)["y"].astype(np.float64)


def test_a_product_gives_what_rounding_both_operands_gives() -> None:
    model, fed = layer(), drawn()
    stored = {
        name: value.const_value.numpy().astype(np.float64)
        for name, value in model.graph.initializers.items()
        if value.const_value is not None
    }
    assert write_float_products(model.graph) == 1

    got = ran(model, fed)

    step = float(np.float32(0.031))
    integers = np.clip(np.rint(fed["x"].astype(np.float64) / step) + 120, 0, 255)
    rounded = (integers.reshape(6, 8) - 120) * step
    want = rounded @ (stored["w"] * stored["ws"]) + stored["b"] * stored["bs"]
    np.testing.assert_allclose(got, want, rtol=1e-5, atol=1e-5)
    assert not any(node.op_type == "DequantizeLinear" for node in model.graph)


@pytest.mark.parametrize(
    "product",
    [
        "y = Gemm(r, wf)",
        "y = Gemm<alpha=0.5>(r, wf, bf)",
        "y = Gemm(r, wf, bf)  seen = QuantizeLinear(y, s, z)",
        "bn = Neg(bf)  y = Gemm(r, wf, bn)",
        "n = Neg(wf)  y = Gemm(r, n, bf)",
        "e = Neg(r)  y = Gemm(e, wf, bf)",
        "i = QuantizeLinear(r, s, signed)  f = DequantizeLinear(i, s, signed)"
        "  y = Gemm(f, wf, bf)",
    ],
)
def test_other_products_stay(product: str) -> None:
    assert write_float_products(layer(product).graph) == 0


def test_a_session_runs_them_in_a_graph_that_it_reads() -> None:
    model = layer(INVERTED)
    model.graph.outputs.append(model.graph[-1].outputs[0])
    model.graph.outputs[-1].type = ir.TensorType(ir.DataType.FLOAT)

    found = [node.op_type for node in optimized(model).graph]

    assert "MatMulIntegerToFloat" in found
    assert "QGemm" not in found
    assert "Gemm" in [node.op_type for node in model.graph]
    # unoptimized, a session is the reference, and runs the file as it is
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    exact = runnable(model, options, CPU)
    assert "Gemm" in [node.op_type for node in exact.graph]
    np.testing.assert_allclose(
        ran(model, drawn()), ran(model, drawn(), optimize=False), rtol=1e-5, atol=1e-5
    )


def test_products_of_one_weight_open_beside_each_other() -> None:
    again = "wg = DequantizeLinear<axis=1>(w, ws, wz)  t = Gemm(r, wg, bf)"
    model = layer(f"{INVERTED}  {again}")
    for node in list(model.graph)[-3:]:
        if node.op_type in {"Inverse", "Gemm"}:
            model.graph.outputs.append(node.outputs[0])
            node.outputs[0].type = ir.TensorType(ir.DataType.FLOAT)

    answers = Session(model, threads=1, int8_kernels=True).run(drawn())

    # onnxruntime refuses a weight of two such products where it adds in 32 bits
    np.testing.assert_array_equal(answers["t"], answers["y"])
