"""Operators, plugins and their calls."""

import onnx
import onnx_ir as ir
import pytest

from me2e_compress.targets import TARGETS, LintFinding
from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.lint.support import LATER, SUPPORTED, UNSUPPORTED
from tests.support.plugins import exported


def found(text: str, opset: int = 17) -> list[LintFinding]:
    head = f'<ir_version: 9, opset_import: ["" : {opset}, "trt" : 1]>'
    return list(TARGETS.parse("tensorrt").lint(ir.from_onnx_text(head + text)))


def said(text: str, opset: int = 17) -> list[tuple[str, str]]:
    return [(each.rule, each.message) for each in found(text, opset)]


def test_every_operator_of_onnx_is_in_one_list() -> None:
    """What onnx releases next must be looked up, not waved through."""
    names = {each.name for each in onnx.defs.get_all_schemas() if each.domain == ""}
    listed = {*SUPPORTED, *LATER, *UNSUPPORTED, "QuantizeLinear", "DequantizeLinear"}
    unknown = {
        "CausalConvWithState", "LinearAttention", "SwiGLU", "Swish",
    }  # fmt: skip

    assert names - listed <= unknown
    assert not set(SUPPORTED) & UNSUPPORTED


@pytest.mark.parametrize(
    ("call", "rule", "message"),
    [
        (
            "(float[2] x) => (uint8[2] y, float s, uint8 z)"
            " { y, s, z = DynamicQuantizeLinear(x) }",
            "operator",
            "TensorRT's parser does not take DynamicQuantizeLinear",
        ),
        (
            "(float[2] x) => (float[2] y) { y = Swish(x) }",
            "operator",
            "Swish stands in no support matrix",
        ),
        (
            "(double[2] x) => (double[2] y) { y = Relu(x) }",
            "element-type",
            "Relu of float64 is cast down",
        ),
        (
            "(int32[1,1,2,2] x) => (int32[A] y) { y = MaxPool<kernel_shape=[1,1]>(x) }",
            "element-type",
            "MaxPool of int32; it accepts bfloat16, float, float16",
        ),
        (
            "(float[2] x, float16[2] h) => (float[2] y) { y = Add(x, h) }",
            "mixed-types",
            "Add of float and float16: cast one of them",
        ),
    ],
)
def test_what_the_parser_does_not_take(call: str, rule: str, message: str) -> None:
    opset = 24 if "Swish" in call else 17
    assert (rule, message) in said(f"m {call}", opset)


@pytest.mark.parametrize(
    "call",
    [
        "(int64[2] x, int64 a, int64 b) => (int64[2] y) { y = Clip(x, a, b) }",
        "(int32[2] x, int32 a) => (int32[2] y) { y = Clip(x, a) }",
        "(bool[2] x) => (int64[1,A] y) { y = NonZero(x) }",
        "(int64[2] x) => (int64[1,A] y) { y = NonZero(x) }",
        "(bool[2] x, bool[2] a) => (bool[2] y) { y = Equal(x, a) }",
        "(float[1,1,9] x, float[1,1,3] w) => (float[1,1,7] y) { y = Conv(x, w) }",
        "(float[1,1,9] x) => (float[1,1,7] y) { y = MaxPool<kernel_shape=[3]>(x) }",
        "(float[2] x) => (float[2] y) { y = Relu(x) }",
    ],
)
def test_what_the_importers_take_beyond_the_matrix(call: str) -> None:
    assert said(f"m {call}", 19) == []


ATTENTION = "(A[1,2,4,8] q) => (A[1,2,4,8] y) { y = Attention(q, q, q) }"
SCATTER = (
    "(float[4] x, int64[2] i, float[2] u) => (float[4] y)"
    ' { y = ScatterElements<reduction="max">(x, i, u) }'
)


@pytest.mark.parametrize(
    ("call", "said"),
    [
        (ATTENTION.replace("A[", "float["), "Attention is parsed, and not built, of"),
        (ATTENTION.replace("A[", "float16["), None),
        (SCATTER, "ScatterElements is not parsed with a reduction, by TensorRT-RTX"),
        (SCATTER.replace("max", "none"), None),
    ],
)
def test_what_tensorrt_rtx_does_not_take_is_a_warning(
    call: str, said: str | None
) -> None:
    model = ir.from_onnx_text(f'<ir_version: 10, opset_import: ["" : 23]> m {call}')

    findings = TensorRT(version="10.15").lint(model)

    told = [each.message for each in findings if each.severity == "warning"]
    assert [each[: len(said or "")] for each in told] == ([said] if said else [])


POWER = "(int64[2] x, int64[2] p) => (int64[2] y) { y = Pow(x, p) }"
NORM = "(float[2,4] x, float[4] s) => (float[2,4] y) { y = RMSNormalization(x, s) }"


@pytest.mark.parametrize(
    ("call", "version", "severity"),
    [
        *((POWER, "", "warning"), (POWER, "10.11", "error"), (POWER, "10.12", None)),
        *((NORM, "", "warning"), (NORM, "10.14", "error"), (NORM, "10.15", None)),
        (NORM, "11.2", None),
    ],
)
def test_a_type_or_an_operator_that_came_later(
    call: str, version: str, severity: str | None
) -> None:
    head = f'<ir_version: 10, opset_import: ["" : {17 if call == POWER else 23}]>'
    model = ir.from_onnx_text(f"{head} m {call}")

    findings = TensorRT(version=version).lint(model)

    said = [each.severity for each in findings if each.rule != "opset"]
    assert said == ([severity] if severity else [])


@pytest.mark.parametrize("text", ["10", "10.x", "ten", "10.13.3.9.1", "v10.13", "10."])
def test_a_version_that_is_none(text: str) -> None:
    with pytest.raises(ValueError, match="is no version of TensorRT, such as"):
        TensorRT(version=text)


@pytest.mark.parametrize(
    ("opset", "version", "severity"),
    [
        (8, "", "error"),
        (9, "", None),
        (20, "", None),
        (21, "", "warning"),
        (25, "", "warning"),
        (26, "", "warning"),
        (21, "10.13", "warning"),
        (24, "10.15", None),
        (25, "11.4", "warning"),
        (25, "11.5", None),
    ],
)
def test_opsets(opset: int, version: str, severity: str | None) -> None:
    text = "m (float[2] x) => (float[2] y) { y = Relu(x) }"
    head = f'<ir_version: 9, opset_import: ["" : {opset}]>'

    found = TensorRT(version=version).lint(ir.from_onnx_text(head + text))

    rules = {each.rule: each.severity for each in found}
    assert rules.get("opset") == severity


ROTATE = "m (float[2,4,4] x, float[1] a, float[2] c) => (float[2,4,4] y) { y = %s }"


@pytest.mark.parametrize(
    ("call", "message"),
    [
        ("trt.RotateTRT<interpolation=1>(x, a, c)", None),
        ("trt.RotateTRT(x, a, c)", "needs attributes interpolation"),
        (
            "trt.RotateTRT<interpolation=1>(x, a)",
            "RotateTRT of BEVFormer_tensorrt takes 3 inputs, found 2",
        ),
        ("trt.RotateTRT<interpolation=1>(a, a, c)", "img is [1], not [C=1, H, W]"),
        ("trt.InverseTRT(x)", "is [2, 4, 4], not ["),
        ("trt.Twist(x)", "trt::Twist is neither an operator nor a known plugin"),
    ],
)
def test_plugins_are_called_as_they_want(call: str, message: str | None) -> None:
    errors = found(ROTATE % call)

    assert [message in each.message for each in errors if message] == (
        [True] if message else []
    )
    assert all(each.rule == "plugin" for each in errors)


def test_deformable_attention_wants_int32_shapes() -> None:
    text = (
        "m (float[1,9,8,4] v, int64[1,2] s, int32[1] l, float[1,5,8,1,4,2] p,"
        " float[1,5,8,1,4] w) => (float[1,5,8,4] y)"
        " { y = trt.MultiscaleDeformableAttnPlugin_TRT(v, s, l, p, w) }"
    )
    (each,) = found(text)

    assert "MultiscaleDeformableAttnPlugin_TRT of" in each.message
    assert "spatial_shapes is int64, not int32" in each.message


def test_a_local_function_stands_in_for_an_operator() -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17, "own" : 1]>
    m (float[2] x) => (float[2] y) { y = own.Twice(x) }
    <domain: "own", opset_import: ["" : 17]>
    Twice (x) => (y) { y = Add(x, x) }
    """
    assert TARGETS.parse("tensorrt").lint(ir.from_onnx_text(text)) == ()


# What TensorRT's parser asks of the attributes and inputs of an operator.


HEAD = '<ir_version: 9, opset_import: ["" : 20]>'
SAMPLED = "m (float[1,1,2,2] x, float[4] s) => (float[1,1,A,B] y)"
AVERAGED = "m (float[1,1,9,9] x) => (float[1,1,A,B] y)"
TAKEN = "m (float[9] x, int64[1] k) => (float[A] y, int64[A] i) <int64[1] most = {9}>"
DEFORMED = (
    "m (float[1,1,4,4] x, float[1,1,1,1] w, float[1,2,6,6] o) => (float[1,1,A,B] y)"
)
RECURRENT = "m (float[2,1,4] x, float[1,12,4] w, float[1,12,3] r) => (float[2,1,1,3] y)"
NORMALIZED = "m (float[2,4] x, float[4] g) => (float[2,4] y, float[2,1] mean)"
SCATTERED = "m (float[4] x, int64[2,1] i, float[2] u) => (float[4] y)"
GRID_5D = "m (float[1,1,2,2,2] x, float[1,2,2,2,3] g) => (float[1,1,2,2,2] y)"
CONV_6D = "m (float[1,1,2,2,2,2] x, float[1,1,1,1,1,1] w) => (float[A] y)"
INDEXED = "m (float[1,1,4,4] x) => (float[1,1,2,2] y, int64[1,1,2,2] i)"
SUMMED = "m (float[2,3] x, int64 a) => (float[2,3] y)"
REDUCED = "m (float[2,4] x, int64[1] a) => (float[2,1] y) <int64[1] one = {1}>"
CALLS = [
    (SAMPLED, "y = Resize(x, , s)", None),
    (SAMPLED, 'y = Resize<mode="linear">(x, , s)', None),
    (SAMPLED, "y = Resize<antialias=0>(x, , s)", None),
    (SAMPLED, "y = Resize<antialias=1>(x, , s)", "antialias must be 0"),
    (
        SAMPLED,
        'y = Resize<coordinate_transformation_mode="align_corners">(x, , s)',
        None,
    ),
    (
        SAMPLED,
        'y = Resize<coordinate_transformation_mode="half_pixel_symmetric">(x, , s)',
        "coordinates half_pixel_symmetric, must be of half_pixel, pytorch_half_pixel,"
        " tf_half_pixel_for_nn, asymmetric, align_corners",
    ),
    (
        SAMPLED,
        'y = Resize<keep_aspect_ratio_policy="not_larger">(x, , s)',
        "aspect ratio policy not_larger, must be stretch",
    ),
    (AVERAGED, "y = AveragePool<kernel_shape=[2,2], dilations=[1,1]>(x)", None),
    (
        AVERAGED,
        "y = AveragePool<kernel_shape=[2,2], dilations=[1,2]>(x)",
        "dilations [1, 2], must be 1",
    ),
    (TAKEN, "y, i = TopK(x, most)", None),
    (TAKEN, "y, i = TopK(x, k)", None),
    (TAKEN, "y, i = TopK<sorted=0>(x, most)", "sorted must be 1"),
    (DEFORMED, "y = DeformConv<pads=[1,1,1,1]>(x, w, o)", None),
    (DEFORMED, "y = DeformConv<pads=[1,2,1,2]>(x, w, o)", None),
    (
        DEFORMED,
        "y = DeformConv<pads=[0,1,2,1]>(x, w, o)",
        "pads [0, 1, 2, 1] differ between begin and end",
    ),
    (RECURRENT, "y = LSTM<hidden_size=3>(x, w, r)", None),
    (RECURRENT, "y = LSTM<hidden_size=3, layout=1>(x, w, r)", "layout must be 0"),
    (NORMALIZED, "y = LayerNormalization(x, g) mean = ReduceMean(x)", None),
    (
        NORMALIZED,
        "y, mean = LayerNormalization(x, g)",
        "only the first output is supported",
    ),
    (TAKEN.replace("{9}", "{4000}"), "y, i = TopK(x, most)", "K = 4000, at most 3840"),
    (
        SCATTERED,
        'y = ScatterND<reduction="add">(x, i, u)',
        "reduction add, must be none",
    ),
    (
        SAMPLED,
        'y = Resize<mode="cubic">(x, , s)',
        "mode cubic, must be nearest or linear",
    ),
    (GRID_5D, "y = GridSample(x, g)", "rank 5, must be 4"),
    (CONV_6D, "y = Conv(x, w)", "rank 6, must be 3, 4 or 5"),
    (
        INDEXED,
        "y, i = MaxPool<kernel_shape=[2,2], strides=[2,2]>(x)",
        "only the first output is supported",
    ),
    (SUMMED, "y = CumSum(x, a)", "axis is computed, must be a constant"),
    (REDUCED, "y = ReduceMean(x, one)", None),
    (REDUCED, "y = ReduceMean(x, a)", "axes is computed, must be a constant"),
]


@pytest.mark.parametrize(("signature", "call", "message"), CALLS)
def test_a_call_as_the_parser_wants_it_or_not(
    signature: str, call: str, message: str | None
) -> None:
    model = ir.from_onnx_text(f"{HEAD} {signature} {{ {call} }}")

    said = [
        each.message
        for each in TARGETS.parse("tensorrt").lint(model)
        if each.rule == "restriction"
    ]

    operator = call.split("= ")[1].partition("(")[0].partition("<")[0]
    assert said == ([] if message is None else [f"{operator}: {message}"])


# Plugin graphs as exporters write them: no domain, no value_info, open outputs.


def exported_findings(
    target: str, *, shapes: bool, domain: str = ""
) -> tuple[LintFinding, ...]:
    return TARGETS.parse(target).lint(exported(shapes=shapes, domain=domain))


@pytest.mark.parametrize("domain", ["", "custom_op", "trt.plugins"])
def test_tensorrt_takes_known_plugins_in_any_domain(domain: str) -> None:
    assert exported_findings("tensorrt", shapes=True, domain=domain) == ()


def test_a_plugin_that_tells_no_shape_is_a_warning_with_the_way_out() -> None:
    findings = exported_findings("tensorrt", shapes=False)
    assert {(each.severity, each.rule) for each in findings} == {
        ("warning", "plugin-shape")
    }
    assert [each.node for each in findings] == ["/rotate", "/inverse"]
    assert "value_info" in findings[0].message


def test_onnxruntime_refuses_the_plugins_and_nothing_else() -> None:
    findings = exported_findings("onnxruntime", shapes=True)
    assert [(each.rule, each.node) for each in findings] == [
        ("operator", "/rotate"),
        ("operator", "/inverse"),
    ]


def test_a_plugin_of_the_default_domain_is_held_against_its_signature() -> None:
    model, other = exported(shapes=True), exported(shapes=True)
    del model.graph[1].attributes["interpolation"]
    (each,) = TARGETS.parse("tensorrt").lint(model)
    assert (each.rule, each.node) == ("plugin", "/rotate")
    other.graph[1].op_type = "Convv"  # nobody knows it
    (each,) = TARGETS.parse("tensorrt").lint(other)
    assert "ai.onnx::Convv is neither an operator nor a known plugin" in each.message
