"""Explicit quantization as TensorRT wants it."""

from collections.abc import Callable
from typing import Any

import ml_dtypes
import numpy as np
import numpy.typing as npt
import onnx
import onnx_ir as ir
import pytest

from me2e_compress.graph import rewrite
from me2e_compress.targets import LintFinding
from me2e_compress.targets.tensorrt import TensorRT
from tests.passes.small import read
from tests.support.nets import conv_attention, parsed, placed

RUNTIME = TensorRT(version="10.7")


def found(text: str, opset: int = 17) -> list[tuple[str, str, str]]:
    model = parsed(f'<ir_version: 9, opset_import: ["" : {opset}]>' + text)
    return [shown(each) for each in RUNTIME.lint(model)]


def shown(finding: LintFinding) -> tuple[str, str, str]:
    return finding.severity, finding.rule, finding.message


@pytest.mark.parametrize("rules", ["paper", "safe"])
def test_what_we_place_has_no_findings(rules: str) -> None:
    assert RUNTIME.lint(placed(conv_attention(), rules=rules)) == ()


def _scale(value: float) -> Callable[[ir.Model], None]:
    def change(model: ir.Model) -> None:
        _replace(model, "image_scale", np.array(value, np.float32))

    return change


def _zero(model: ir.Model) -> None:
    _replace(model, "int8_zero", np.array(3, np.int8))


def _axis(model: ir.Model) -> None:
    node = _dequantize(model, "w_int8")
    node.attributes["axis"] = ir.AttrInt64("axis", 3)
    _replace(model, "w_scale", np.ones(3, np.float32))
    _replace(model, "w_zero", np.zeros(3, np.int8))


def _other_axis(model: ir.Model) -> None:
    _dequantize(model, "l_int8").attributes["axis"] = ir.AttrInt64("axis", 0)


def _no_axis(model: ir.Model) -> None:
    _dequantize(model, "l_int8").attributes.pop("axis")


def _activation_by_channel(model: ir.Model) -> None:
    _replace(model, "image_scale", np.ones(3, np.float32))
    _replace(model, "int8_zero", np.zeros(3, np.int8))


def _computed_scale(model: ir.Model) -> None:
    node = next(n for n in model.graph if n.op_type == "QuantizeLinear")
    scale = ir.node("Abs", [node.inputs[1]])
    scale.outputs[0].name = "computed"
    model.graph.insert_before(node, scale)
    node.replace_input_with(1, scale.outputs[0])


def _float_reader(model: ir.Model) -> None:
    conv = next(n for n in model.graph if n.op_type == "Conv")
    conv.replace_input_with(0, model.graph.inputs[0])


def _float_weight(model: ir.Model) -> None:
    conv = next(n for n in model.graph if n.op_type == "Conv")
    weight = rewrite.add_constant(model.graph, np.ones((8, 3, 3, 3), np.float32), "v")
    conv.replace_input_with(1, weight)


def _replace(model: ir.Model, name: str, array: np.ndarray) -> None:
    value = model.graph.initializers[name]
    value.const_value = ir.tensor(array, name=name)
    value.shape = ir.Shape(array.shape)
    value.type = ir.TensorType(value.const_value.dtype)


def _dequantize(model: ir.Model, integers: str) -> ir.Node:
    return next(
        node
        for node in model.graph
        if node.op_type == "DequantizeLinear"
        and node.inputs[0] is not None
        and node.inputs[0].name == integers
    )


@pytest.mark.parametrize(
    ("change", "rule", "message"),
    [
        (_scale(0.0), "scale", "scale 0, must be finite and above 0"),
        (_scale(-1.0), "scale", "scale -1, must be finite and above 0"),
        (_scale(float("inf")), "scale", "scale inf, must be finite and above 0"),
        (_computed_scale, "scale", "the scale is computed, must be a constant"),
        (_zero, "zero-point", "zero point 3, must be 0"),
        (_axis, "weight-axis", "scales along axis 3; output channels of Conv run"),
        (_other_axis, "weight-axis", "scales along axis 0; output channels of MatMul"),
        (_no_axis, "weight-axis", "no axis: ONNX takes 1, TensorRT takes 0"),
        (_activation_by_channel, "channel-scale", "an activation has one scale a ch"),
        (_float_reader, "half-quantized", "its activation is float: it runs in float"),
        (_float_weight, "half-quantized", "its weight is float: it runs in float"),
    ],
)
def test_what_is_broken_is_found(
    change: Callable[[ir.Model], None], rule: str, message: str
) -> None:
    model = placed(conv_attention())
    change(model)

    ours = [each for each in RUNTIME.lint(model) if each.rule == rule]

    assert ours
    assert message in ours[0].message


VECTOR = "m (float[2] x) => (float[2] y)"
IMAGE = "m (float[1,1,4,4] x, float[1,1,1,1] w) => (float[1,1,4,4] y)"
SQUARE = "m (float[2,2] x) => (float[2,2] y)"
PAIR = "<float s = {0.5}, float t = {0.25}, int8 z = {0}, uint8 u = {0}, int32 i = {0}>"
QUANTIZED = PAIR + "{ q = QuantizeLinear(x, s, z)"
ROUNDED = QUANTIZED + " d = DequantizeLinear(q, s, z)"
TYPES = "uint8, must be int8 or float8e4m3fn"


@pytest.mark.parametrize(
    ("text", "severity", "rule", "message"),
    [
        (
            f"{VECTOR} {PAIR} {{ q = QuantizeLinear(x, s, u)"
            " d = DequantizeLinear(q, s, u) y = Relu(d) }",
            *("error", "quantized-type", TYPES),
        ),
        (
            f"{VECTOR} {PAIR} {{ q = QuantizeLinear(x, s)"
            " d = DequantizeLinear(q, s) y = Relu(d) }",
            *("error", "quantized-type", TYPES),
        ),
        (
            f"{VECTOR} {QUANTIZED} d = DequantizeLinear(q, t, z) y = Relu(d) }}",
            *("error", "unpaired", "quantized and dequantized on two scales"),
        ),
        (
            f"m (float[2] x) => (int8[2] q) {QUANTIZED} }}",
            *("error", "unpaired", "its integers are a graph output"),
        ),
        (
            f"m (float[2] x) => (int8[2] y) {QUANTIZED} y = Identity(q) }}",
            *("error", "unpaired", "its integers are read by Identity"),
        ),
        (
            f"m (int8[2] x) => (float[2] y) {PAIR}"
            "{ d = DequantizeLinear(x, s, z) y = Relu(d) }",
            *("error", "unpaired", "reads integers of a graph input"),
        ),
        (
            f"m (float x) => (float y) {ROUNDED} y = Relu(d) }}",
            *("error", "scalar-pair", "QuantizeLinear of a 0-D tensor"),
        ),
        *(
            (
                f"m (float[2] x) => ({kind}[2] y) {ROUNDED} y = Cast<to={to}>(d) }}",
                *("error", "integer-pair", "a dequantized tensor is cast to an index"),
            )
            for kind, to in (("int64", 7), ("int32", 6))
        ),
        (
            f"{VECTOR} {QUANTIZED} y = DequantizeLinear(q, s, z) }}",
            *("warning", "output-pair", "graph output y is rounded"),
        ),
        (
            f"{VECTOR} {ROUNDED} p = QuantizeLinear(d, t, z)"
            " e = DequantizeLinear(p, t, z) y = Relu(e) }",
            *("warning", "repeated-pair", "quantizes what was just dequantized"),
        ),
        (
            f"{IMAGE} <int32[1] b = {{7}}, float s = {{0.5}}, int32 z = {{0}}>"
            " { d = DequantizeLinear(b, s, z) y = Conv(x, w, d) }",
            *("error", "bias-pair", "the bias is quantized, must be float"),
        ),
        (
            f"{SQUARE} <float[2,2] w = {{1.0, 2.0, 3.0, 4.0}}, float s = {{0.5}},"
            " int8 z = {0}> { q = QuantizeLinear(w, s, z)"
            " d = DequantizeLinear(q, s, z) y = MatMul(x, d) }",
            *("warning", "float-weight", "the weight is stored as float"),
        ),
        (
            f"{IMAGE} {PAIR} {{ c = Conv(x, w) q = QuantizeLinear(c, s, z)"
            " d = DequantizeLinear(q, s, z) y = Add(d, x) }",
            *("warning", "residual-branch", "a pair between a convolution and its Add"),
        ),
    ],
)
def test_pairs_that_are_wrong(
    text: str, severity: str, rule: str, message: str
) -> None:
    assert any(
        each[:2] == (severity, rule) and message in each[2] for each in found(text)
    )


def test_a_rounded_projection_is_a_residual_branch() -> None:
    text = """m (float[1,1,4,4] x, float[1,1,1,1] w) => (float[1,1,4,4] y)
    <float s = {0.5}, int8 z = {0}>
    { c = Conv(x, w) p = Conv(x, w) q = QuantizeLinear(p, s, z)
      d = DequantizeLinear(q, s, z) y = Add(c, d) }"""

    assert "residual-branch" not in [each[1] for each in found(text)]


# FP8 pairs and int4 weights by block: TensorRT takes both.


ONE, FP8 = np.float32(0.01), ml_dtypes.float8_e4m3fn
PAIRED = "q = QuantizeLinear(x, s, z) d = DequantizeLinear(q, s, z)"


def rules_of(body: str, **weights: npt.NDArray[Any] | np.generic) -> set[str]:
    """What is found at opset 21; weights have the types of these arrays."""
    text = '<ir_version: 10, opset_import: ["" : 21]>'
    model = read(f"{text} g (float[4,32] x) => (float[4,32] y) {{ {body} }}", **weights)
    onnx.checker.check_model(ir.to_proto(model), full_check=True)
    return {each.rule for each in TensorRT().lint(model)} - {"opset"}


def test_fp8_pairs_of_activation_and_weight_are_taken() -> None:
    numbers = np.arange(1024, dtype=np.uint8).reshape(32, 32) % 64
    body = f"{PAIRED} wd = DequantizeLinear(w, s, z) y = MatMul(d, wd)"
    w: npt.NDArray[Any] = numbers.view(FP8)

    assert rules_of(body, w=w, s=ONE, z=np.zeros((), FP8)) == set()


@pytest.mark.parametrize(
    ("kind", "rules"),
    [(ml_dtypes.int4, set()), (np.int8, {"channel-scale", "half-quantized"})],
)
def test_int4_weights_alone_have_scales_by_block(kind: type, rules: set[str]) -> None:
    w: npt.NDArray[Any] = (np.arange(1024) % 15 - 7).reshape(32, 32).astype(kind)
    body = "wd = DequantizeLinear<axis=0, block_size=16>(w, s) y = MatMul(x, wd)"

    assert rules_of(body, w=w, s=np.full((2, 32), ONE)) == rules


def test_an_activation_in_int4_is_refused() -> None:
    body = PAIRED.replace("d =", "y =")

    assert "quantized-type" in rules_of(body, s=ONE, z=np.zeros((), ml_dtypes.int4))


CLIPPED = """
m (float[1,8] x) => (float[1,8] y)
<float s = {0.1}, int8 z = {0}, int8 low = {-127}, int8 high = {127}>
{ q = QuantizeLinear(x, s, z) c = Clip(q, low, high) d = DequantizeLinear(c, s, z)
  y = Relu(d) }
"""


def test_a_clip_between_the_nodes_of_a_pair_is_looked_past() -> None:
    """As brevitas writes it: TensorRT-RTX 1.7 builds int8 kernels of such pairs."""
    wrong = {"element-type", "unpaired"}
    read_too = CLIPPED.replace("[1,8] y)", "[1,8] y, int8[1,8] q)")

    assert not wrong & {rule for _, rule, _ in found(CLIPPED)}
    assert "unpaired" in {rule for _, rule, _ in found(read_too)}
