"""Matrix-vector products whose weight alone becomes int8."""

import dataclasses
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.calibration.dataset import CalibrationSet
from me2e_compress.manager import PassManager
from me2e_compress.passes import Context
from me2e_compress.passes.base import PassResult
from me2e_compress.passes.quantize_int8 import QuantizeInt8
from me2e_compress.quantization.plan import WEIGHT_ONLY, plan_of
from me2e_compress.runtime.session import Session
from me2e_compress.targets import TARGETS
from me2e_compress.targets.weights import quantize_weight
from me2e_compress.workflows.int8_outcome import float_weights
from tests.frames import record
from tests.nets import MODULES, net

Floats = npt.NDArray[np.float32]
OPTIONS = QuantizeInt8(weight_only_gemv=True)
BIASED = '["M"] m = MatMul(x, w) ["A"] y = Add(m, b)'
FORMS = {
    "Gemm": ("float[1,%(k)d]", "float[%(k)d,%(n)d]", "y = Gemm(x, w, b)"),
    "Gemm, transposed": (
        "float[1,%(k)d]", "float[%(n)d,%(k)d]", "y = Gemm<transB = 1>(x, w, b)",
    ),
    "MatMul": (
        "float[1,1,%(k)d]", "float[%(k)d,%(n)d]", BIASED,
    ),
    "MatMul by [1, K, N]": (
        "float[1,1,%(k)d]", "float[1,%(k)d,%(n)d]", BIASED,
    ),
}  # fmt: skip


def head(form: str, k: int, n: int, weight: Floats, bias: Floats) -> ir.Model:
    """One matrix-vector layer, [K] to [N]; the weight is given as [K, N]."""
    x, w, body = (text % {"k": k, "n": n} for text in FORMS[form])
    shape = [int(size) for size in w[6:-1].split(",")]
    held = weight.T if "transposed" in form else weight
    text = (
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"head ({x} x, {w} w, float[{n}] b) => (float y) {{ {body} }}"
    )
    return net(text, {"w": held.reshape(shape), "b": bias})


def compressed(model: ir.Model, options: QuantizeInt8 = OPTIONS) -> PassResult:
    """No frames: none are needed."""
    return options.run(model, Context(MODULES))


@pytest.mark.parametrize("target", ["onnxruntime", "tensorrt"])
@pytest.mark.parametrize("form", FORMS)
def test_a_weight_is_stored_as_int8_and_its_product_stays_float(
    form: str, target: str
) -> None:
    weight = np.ones((128, 64), np.float32)
    model = head(form, 128, 64, weight, np.ones(64, np.float32))

    result = compressed(model, dataclasses.replace(OPTIONS, target=target))

    plan = plan_of(result.model)
    assert plan is not None
    (found,) = plan.weight_only
    assert (found.dtype, found.rule) == (WEIGHT_ONLY, "gemv")
    assert "its weight alone is int8" in found.reason
    assert result.changes == 1
    assert next(n.op_type for n in result.model.graph) == "DequantizeLinear"
    assert "QuantizeLinear" not in {n.op_type for n in result.model.graph}
    assert graph.size(result.model).weight_bytes < weight.nbytes // 2
    assert float_weights(model, plan) == ()
    assert TARGETS.parse(target).lint(result.model) == ()


@pytest.mark.parametrize("form", FORMS)
def test_what_it_changes_names_the_pass(form: str) -> None:
    weight = np.ones((128, 64), np.float32)
    model = head(form, 128, 64, weight, np.ones(64, np.float32))

    report = PassManager((OPTIONS,), verify_frames=0).run(model, Context(MODULES))

    assert [step.changes for step in report.steps] == [1]


@pytest.mark.parametrize("seed", range(8))
def test_the_result_differs_by_the_rounding_of_the_weight_alone(seed: int) -> None:
    """As the graph says it, beside float64; the runtime's own kernels are not asked."""
    draw = np.random.default_rng(seed)
    form = list(FORMS)[seed % len(FORMS)]
    k, n = int(draw.integers(64, 400)), int(draw.integers(64, 300))
    weight = (draw.normal(size=(k, n)) * draw.uniform(0.01, 9, size=n)).astype("f4")
    bias = draw.normal(size=n).astype(np.float32)
    x = draw.normal(size=k).astype(np.float32)
    model = head(form, k, n, weight, bias)
    shape = graph.static_shape(model.graph.inputs[0])
    assert shape is not None

    stored = Session(compressed(model).model, optimize=False)

    (answer,) = stored.run({"x": x.reshape(shape)}).values()
    found = answer.astype(np.float64).reshape(-1)
    integers, steps = quantize_weight(weight, 1)
    rounded = x.astype(np.float64) @ (integers * steps.astype(np.float64)) + bias
    exact = x.astype(np.float64) @ weight.astype(np.float64) + bias
    reach = np.abs(rounded).max()
    assert np.abs(found - rounded).max() < 1e-5 * reach
    most = 0.5 * steps * np.abs(x).sum()  # half a step a weight
    assert (np.abs(found - exact) <= most + 1e-5 * reach).all()


@pytest.mark.parametrize("form", FORMS)
def test_onnxruntime_reads_the_integers_in_one_kernel(
    form: str, tmp_path: Path
) -> None:
    weight = np.random.default_rng(0).normal(size=(128, 64)).astype(np.float32)
    model = head(form, 128, 64, weight, np.ones(64, np.float32))
    options = dataclasses.replace(OPTIONS, target="onnxruntime")

    rewritten = tmp_path / "rewritten.onnx"
    Session(compressed(model, options).model, rewritten=rewritten)

    kernels = {node.op_type for node in graph.load(rewritten).graph}
    assert "MatMulNBits" in kernels
    assert "DequantizeLinear" not in kernels


@pytest.mark.parametrize(
    ("k", "n", "text", "why"),
    [
        (63, 64, "m = MatMul(x, w) y = Add(m, b)", "it is small"),
        (128, 64, "m = MatMul(x, w) v = Abs(w) y = Mul(m, v)", "others read it too"),
    ],
)
def test_other_weights_stay_float(k: int, n: int, text: str, why: str) -> None:
    model = net(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        f"head (float[1,{k}] x, float[{k},{n}] w, float[{n}] b) => (float y)"
        f" {{ {text} }}",
        {"w": np.ones((k, n)), "b": np.ones(n)},
    )

    assert compressed(model).changes == 0, why


def test_int8_layers_and_stored_weights_stand_in_one_graph(tmp_path: Path) -> None:
    text = (
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "mixed (float[8,64] x, float[64,64] w, float[64,64] v) => (float y)"
        " { a = MatMul(x, w) m = ReduceMean<axes = [0], keepdims = 1>(a)"
        " y = MatMul(m, v) }"
    )
    draws = np.random.default_rng(0).normal(size=(2, 64, 64))
    model = net(text, {"w": draws[0], "v": draws[1]})
    x = np.random.default_rng(1).normal(size=(8, 64)).astype(np.float32)
    frames = CalibrationSet(record(tmp_path / "frames", [{"x": x}]))

    result = OPTIONS.run(model, Context(MODULES, frames))

    plan = plan_of(result.model)
    assert plan is not None
    assert (len(plan.chosen), len(plan.weight_only), result.changes) == (1, 1, 2)
    notes = "\n".join(result.notes)
    assert "1 of 3 nodes int8, the weights alone of 1 more" in notes


def test_the_report_says_what_it_would_save() -> None:
    weight = np.ones((512, 500), np.float32)
    model = head("MatMul", 512, 500, weight, np.ones(500, np.float32))

    notes = compressed(model, QuantizeInt8()).notes

    assert any("weight_only_gemv=true would save 0.8 MB: 1 weights" in n for n in notes)
