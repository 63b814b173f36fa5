"""Quantized Gemms that are read in float, as our sessions open them."""

from pathlib import Path
from typing import Any

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import onnxruntime
import onnxruntime as ort
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import EvaluationError, GraphError
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.driving import onnx_policy
from me2e_compress.driving.onnx_policy import OnnxPolicy
from me2e_compress.manager import PassManager
from me2e_compress.passes.base import Context
from me2e_compress.passes.import_normalize import ImportNormalize
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.runtime.int8_values import write_float_products
from me2e_compress.runtime.optimized import optimize
from me2e_compress.runtime.providers import CPU
from me2e_compress.runtime.runnable import int8_entry, make_runnable
from me2e_compress.runtime.session import Session
from tests.manager.transformer import transformer
from tests.passes.small import EVERYTHING, read
from tests.support.frames import record
from tests.support.nets import parsed, stored
from tests.targets.onnxruntime.rewritten import Drawn

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
    return stored(parsed(LAYER.replace("PRODUCT", product)), arrays)


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
    held = {
        name: value.const_value.numpy().astype(np.float64)
        for name, value in model.graph.initializers.items()
        if value.const_value is not None
    }
    assert write_float_products(model.graph) == 1

    got = ran(model, fed)

    step = float(np.float32(0.031))
    integers = np.clip(np.rint(fed["x"].astype(np.float64) / step) + 120, 0, 255)
    rounded = (integers.reshape(6, 8) - 120) * step
    want = rounded @ (held["w"] * held["ws"]) + held["b"] * held["bs"]
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

    found = [node.op_type for node in optimize(model).graph]

    assert "MatMulIntegerToFloat" in found
    assert "QGemm" not in found
    assert "Gemm" in [node.op_type for node in model.graph]
    # unoptimized, a session is the reference, and runs the file as it is
    options = ort.SessionOptions()
    options.graph_optimization_level = ort.GraphOptimizationLevel.ORT_DISABLE_ALL
    exact = make_runnable(model, options, CPU)
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


# Who times or drives a graph runs it as onnxruntime does; who measures, as written.


def test_what_is_timed_is_what_onnxruntime_runs(tmp_path: Path) -> None:
    layer = Drawn("Gemm", bias="own")
    path = tmp_path / "layer.onnx"
    graph.save(layer.model(), path)
    frame = layer.frame()
    plain, kernels = (
        np.asarray(Session(path, int8_kernels=s).run(frame)["y"], np.float64)
        for s in (False, True)
    )

    timed = Session(path, threads=1, int8_kernels=True).run(frame)["y"]

    np.testing.assert_array_equal(timed, kernels)
    assert np.abs(plain - kernels).max() > 1


def test_what_drives_is_what_onnxruntime_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    given: dict[str, object] = {}

    def refuse(path: Path, **options: object) -> None:
        given.update(options)
        raise GraphError("seen")

    monkeypatch.setattr(onnx_policy, "Session", refuse)
    with pytest.raises(EvaluationError, match="seen"):
        OnnxPolicy.open(Path("m.onnx"))

    assert given["int8_kernels"] is True


OVERFLOWS = """<ir_version: 9, opset_import: ["" : 17]>
m (float[8,64] x) => (float[8,16] y)
<float one = {1.0}, uint8 zero = {0}, float far = {8192.0},
 float farther = {1.6e7}, int8 none = {0}> {
    q = QuantizeLinear(x, one, zero)
    d = DequantizeLinear(q, one, zero)
    v = DequantizeLinear(w, one, none)
    a = Gemm(d, v)
    b = QuantizeLinear(a, far, zero)
    c = DequantizeLinear(b, far, zero)
    e = DequantizeLinear(u, one, none)
    g = Gemm(c, e)
    f = QuantizeLinear(g, farther, zero)
    y = DequantizeLinear(f, farther, zero)
}"""
"""Two int8 layers with one zero point; the first sums products of 255 by 127."""


def test_sums_of_int8_do_not_overflow_on_any_processor(tmp_path: Path) -> None:
    draws = np.random.default_rng(0)
    large = draws.integers(100, 128, (64, 16)).astype(np.int8)
    model = read(OVERFLOWS, w=large, u=draws.integers(0, 128, (16, 16)).astype(np.int8))
    x = draws.integers(200, 256, (8, 64)).astype(np.float32)
    graph.save(model, tmp_path / "m.onnx")
    opened: list[ir.Model | Path] = [model, tmp_path / "m.onnx"]
    for source in opened:
        session = Session(source, threads=1, int8_kernels=True)
        by_kernels = session.run({"x": x})["y"]
        by_nodes = Session(source, threads=1, optimize=False).run({"x": x})["y"]
        np.testing.assert_array_equal(by_kernels, by_nodes)
    assert (x @ large).min() > 32767  # where 16 bits end


@pytest.mark.parametrize("wrong", [0, 1])
def test_sums_are_asked_for_in_32_bits_where_they_overflow_alone(
    monkeypatch: pytest.MonkeyPatch, wrong: int
) -> None:
    def run(_self: object, _names: None, inputs: dict[str, Any]) -> list[object]:
        return [inputs["x"][:, :16].astype(np.int32) * 64 * 127 - wrong]

    monkeypatch.setattr(onnxruntime.InferenceSession, "run", run)
    entry = int8_entry.__wrapped__()
    assert entry == ("session.x64quantprecision", str(wrong))


def test_a_written_file_opens_in_plain_onnxruntime_where_sums_must_not_overflow(
    tmp_path: Path,
) -> None:
    frames = np.random.default_rng(1).normal(size=(3, 1, 64, 64)).astype(np.float32)
    recording = CalibrationSet(record(tmp_path / "f", [{"x": each} for each in frames]))
    passes = (ImportNormalize(), QuantizeInt8(target="onnxruntime"))
    manager = PassManager(passes)
    model = manager.run(transformer(), Context(EVERYTHING, recording)).model
    options = onnxruntime.SessionOptions()
    options.add_session_config_entry("session.x64quantprecision", "1")
    options.intra_op_num_threads = 1

    session = onnxruntime.InferenceSession(
        ir.to_proto(model).SerializeToString(), options
    )

    (plain,) = session.run(None, {"x": frames[0]})
    ours = Session(model, threads=1, int8_kernels=True).run({"x": frames[0]})["y"]
    np.testing.assert_array_equal(np.asarray(plain), ours)
