"""Which quantizers' files are slow in onnxruntime's CPU, and for whom."""

from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest
from onnxruntime.quantization import (
    CalibrationDataReader,
    QuantFormat,
    QuantType,
    quantize_static,
)

from me2e_compress import graph
from me2e_compress.calibration.ranges import Ranges
from me2e_compress.quantization.plan import make_plan
from me2e_compress.quantization.scheme import QuantScheme
from me2e_compress.runtime.providers import (
    CpuProvider,
    CudaProvider,
    TensorRtProvider,
    TensorRtRtxProvider,
)
from me2e_compress.targets import TARGETS
from me2e_compress.targets.onnxruntime import slow_here
from tests.nets import MODULES, PAPER, conv_attention, save_text
from tests.targets.onnxruntime.test_slow_form import AS_FLOAT, FLOATS, INTEGERS, STORED

CHAIN = """
<ir_version: 10, opset_import: ["" : %(opset)d]>
m (float[1,8,4,4] x) => (float[1,8,4,4] y)
<float s = {0.05}, %(constants)s> {
    q = %(quantize)s(x, s%(z)s)
    d = DequantizeLinear(q, s%(z)s)
    %(weights)s
    c = Conv(d, v)
    r = Relu(c)
    q2 = %(quantize)s(r, s%(z)s)
    d2 = DequantizeLinear(q2, s%(z)s)
    y = Conv(d2, v)
}
"""
LOWERED = "--passes import-normalize,lower-int8 makes it of this file"


def chain(form: str) -> ir.Model:
    """Two convolutions and a ReLU, with pairs on what layers read."""
    floats = f"float[8,8,1,1] w = {{{FLOATS}}}, int8 n = {{0}}"
    stored = f"int8[8,8,1,1] w = {{{INTEGERS}}}, int8 n = {{0}}"
    fp8 = 17  # FLOAT8E4M3FN
    constants, weights, quantize, z, opset = {
        "ours": (stored, STORED, "QuantizeLinear", ", n", 13),
        "modelopt": (floats, AS_FLOAT, "QuantizeLinear", ", n", 19),
        "no zero point": (stored, STORED, "QuantizeLinear<output_dtype=3>", "", 21),
        "fp8": (stored, STORED, f"QuantizeLinear<output_dtype={fp8}>", "", 21),
        "uint8": (f"{stored}, uint8 z = {{128}}", STORED, "QuantizeLinear", ", z", 17),
        "shifted": (f"{stored}, int8 z = {{3}}", STORED, "QuantizeLinear", ", z", 17),
        "int16": (stored, STORED, "QuantizeLinear<output_dtype=5>", "", 21),
    }[form]
    words = {"constants": constants, "weights": weights, "quantize": quantize}
    return ir.from_onnx_text(CHAIN % {**words, "z": z, "opset": opset})


@pytest.mark.parametrize(
    ("form", "shape", "remedy"),
    [
        ("ours", "TensorRT's form,", True),
        ("modelopt", "TensorRT's form,", True),
        ("no zero point", "TensorRT's form,", True),
        ("fp8", "TensorRT's form,", False),
        ("uint8", "a form that is", False),
        ("shifted", "a form that is", False),
        ("int16", "a form that is", False),
    ],
)
def test_pairs_on_inputs_alone_are_slow_whoever_placed_them(
    form: str, shape: str, remedy: bool
) -> None:
    said = slow_here(chain(form)) or ""

    assert f"quantized in {shape} slow in onnxruntime's CPU" in said
    assert "(no fast kernel for 2 of 2 layers)" in said
    assert "compress --target onnxruntime writes what is fast here" in said
    assert (LOWERED in said) == remedy


def test_another_provider_runs_that_form_well() -> None:
    model = chain("modelopt")

    assert slow_here(model, CpuProvider(plugins=(Path("library.so"),))) is not None
    for provider in (CudaProvider(), TensorRtProvider(), TensorRtRtxProvider()):
        assert slow_here(model, provider) is None


@pytest.mark.parametrize(("target", "is_slow"), [("tensorrt", 1), ("onnxruntime", 0)])
def test_what_is_placed_for_the_cpu_is_not_slow_there(
    target: str, is_slow: bool
) -> None:
    model = conv_attention()
    plan = make_plan(model, QuantScheme.named("full", MODULES), PAPER)
    place = TARGETS.parse(target)
    ranges = dict.fromkeys(place.tensors(plan, model), (-3.0, 3.0))

    placed = place.place(model, plan, Ranges(ranges, "max-min", 1, "", ""))

    assert slow_here(model) is None
    assert (slow_here(placed) is not None) == is_slow


class Drawn(CalibrationDataReader):  # type: ignore[misc]
    """Normal numbers for the input ``x``, drawn anew."""

    def __init__(self) -> None:
        draws = np.random.default_rng()
        shape = (1, 8, 4, 4)
        self._left = [{"x": draws.normal(size=shape).astype(np.float32)}] * 2

    def get_next(self) -> dict[str, np.ndarray]:
        # an empty mapping ends the data, and keeps to the base class's type
        return self._left.pop() if self._left else {}


@pytest.mark.parametrize(
    ("kind", "options"),
    [
        (QuantType.QUInt8, {}),
        (QuantType.QInt8, {}),
        (QuantType.QInt8, {"ActivationSymmetric": True}),
    ],
)
def test_what_onnxruntimes_own_quantizer_writes_is_not_slow(
    kind: QuantType, options: dict[str, bool], tmp_path: Path
) -> None:
    """It puts a pair behind every layer; sessions make its int8 uint8 by themselves."""
    text = "m (float[1,8,4,4] x) => (float[1,8,4,4] y)"
    text += f" <float[8,8,1,1] v = {{{FLOATS}}}>"
    source = save_text(
        tmp_path / "f.onnx", text + "{ c = Conv(x, v) r = Relu(c) y = Conv(r, v) }"
    )
    target = tmp_path / "q.onnx"
    quantize_static(
        source, target, Drawn(), quant_format=QuantFormat.QDQ, per_channel=True,
        activation_type=kind, weight_type=QuantType.QInt8, extra_options=options,
    )  # fmt: skip

    assert slow_here(graph.load(target)) is None
