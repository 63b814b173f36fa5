import numpy as np
import pytest

from me2e_compress.targets.onnxruntime import OnnxRuntime
from tests.support.nets import net, parsed, placed


@pytest.mark.parametrize(
    ("operator", "remedy"),
    [
        ("trt.Unheard", ""),
        (
            "trt.InverseTRT",
            ": attach-bodies writes one, expand-operators the body in its place",
        ),
        ("InverseTRT", ": expand-operators writes its body"),
    ],
)
def test_operators_without_a_kernel(operator: str, remedy: str) -> None:
    model = parsed(
        '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>'
        f"m (float[1,2,3,3] x) => (float[1,2,3,3] y) {{ y = {operator}(x) }}"
    )
    (found,) = OnnxRuntime().lint(model)

    domain, _, name = operator.rpartition(".")
    said = f"{domain or 'ai.onnx'}::{name} has no kernel and no local function"
    assert found.message == said + remedy


def test_contrib_operators_are_known() -> None:
    model = parsed(
        '<ir_version: 9, opset_import: ["" : 17, "com.microsoft" : 1]>'
        "m (float[2] x) => (float[2] y) { y = com.microsoft.Gelu(x) }"
    )
    assert OnnxRuntime().lint(model) == ()


def test_opsets_nobody_has_released() -> None:
    model = parsed(
        '<ir_version: 9, opset_import: ["" : 99]>'
        "m (float[2] x) => (float[2] y) { y = Relu(x) }"
    )
    assert "opset" in [each.rule for each in OnnxRuntime().lint(model)]


def test_a_float_convolution_behind_an_int8_one_needs_no_answer() -> None:
    text = """
    up (float[1,8,4,4] x, float[8,8,1,1] w, float[8,8,2,2] t) => (float[1,8,8,8] y) {
        c = Conv(x, w)
        r = Relu(c)
        y = ConvTranspose<kernel_shape=[2,2], strides=[2,2]>(r, t)
    }
    """
    model = net(text, {"w": np.ones((8, 8, 1, 1)), "t": np.ones((8, 8, 2, 2))})

    assert OnnxRuntime().lint(placed(model, "onnxruntime")) == ()


@pytest.mark.parametrize(
    ("before", "pad", "found"),
    [
        ("Tanh", "", ["padded-pool"]),
        ("Tanh", ", zero", ["padded-pool"]),
        ("Tanh", ", one", []),
        ("Relu", "", []),
    ],
)
def test_pads_that_onnxruntime_folds_into_a_pool(
    monkeypatch: pytest.MonkeyPatch, before: str, pad: str, found: list[str]
) -> None:
    model = parsed(
        "m (float[1,1,2,2] x) => (float[1,1,2,2] y)\n"
        "<int64[8] p = {0,0,1,1,0,0,1,1}, float zero = {0.0}, float one = {1.0}>\n"
        f"{{ a = {before}(x) [edge] b = Pad(a, p{pad})"
        " [pool] y = MaxPool<kernel_shape=[3,3]>(b) }"
    )
    assert OnnxRuntime().lint(model) == ()  # mended since
    monkeypatch.setattr("onnxruntime.__version__", "1.31.2")
    lint = OnnxRuntime().lint(model)

    assert [each.rule for each in lint] == found
    assert all("Pad 'edge'" in each.message for each in lint)
    assert {each.severity for each in lint} <= {"wrong"}  # it runs


def test_a_scale_that_is_neither_a_number_nor_a_row_is_an_error() -> None:
    text = """<ir_version: 10, opset_import: ["" : 21]>
    m (float[1,2,4,4] x) => (float[1,2,4,4] y)
    <int8[2,2,1,1] w = {1,2,3,4}, float[%s] s = {0.1,0.2}>
    { [pair] d = DequantizeLinear<axis=%s>(w, s) y = Conv(x, d) }"""
    wrong, row = text % ("2,1", "0"), text % ("2", "0")
    blocks = text % ("2,1,1,1", "1, block_size=2")

    (found,) = OnnxRuntime().lint(parsed(wrong))
    assert (found.severity, found.rule, found.node) == ("error", "scale-shape", "pair")
    assert "[2, 1]" in found.message
    assert OnnxRuntime().lint(parsed(row)) == OnnxRuntime().lint(parsed(blocks)) == ()


SAMPLED = "(float[1,1,2,2] x, double[1,1,1,2] g) => (float[1,1,1,1] y)"
SAMPLE = """
    a = Cast<to=11>(x) [sampler] s = GridSample(a, g) y = Cast<to=1>(s)
"""


def no_kernels(opset: int, signature: str, body: str) -> list[str]:
    model = parsed(
        f'<ir_version: 9, opset_import: ["" : {opset}]> m {signature} {{ {body} }}'
    )
    return [
        f"{each.node}: {each.message}"
        for each in OnnxRuntime().lint(model)
        if each.rule == "kernel" and each.severity == "error"
    ]


def test_types_that_no_kernel_takes_and_a_newer_one_does() -> None:
    assert no_kernels(16, SAMPLED, SAMPLE) == [
        "sampler: onnxruntime has no kernel for GridSample of float64"
    ]
    assert no_kernels(20, SAMPLED, SAMPLE) == []


def test_float64_within_a_graph_has_a_remedy() -> None:
    signature = SAMPLED.replace("double[1,1,1,2]", "float[1,1,1,2]")
    body = SAMPLE.replace("(a, g)", "(a, b)").replace("a =", "b = Cast<to=11>(g) a =")

    (said,) = no_kernels(16, signature, body)

    assert said.endswith(": import-normalize makes it float32 (compress -r exact)")


@pytest.mark.parametrize(
    "call",
    [
        "(float16[2] x) => (float16[2] y) { y = Erf(x) }",  # cast to float32
        "(double[2] x) => (double[2] y) { y = Gelu(x) }",  # made of others
        "(double[2] x) => (double[2] y) { a = Sigmoid(x) y = Mul(x, a) }",
    ],
)
def test_types_that_onnxruntime_gets_along_with(call: str) -> None:
    signature, _, body = call.partition(" {")

    assert no_kernels(20, signature, body.rstrip("}")) == []
