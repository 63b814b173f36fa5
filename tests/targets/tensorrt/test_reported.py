"""What users report of TensorRT: each row finds its pattern, in its versions alone."""

import dataclasses
import re
from pathlib import Path

import onnx_ir as ir
import pytest

from me2e_compress.targets.tensorrt import TensorRT
from me2e_compress.targets.tensorrt.lint.reported import FAULTS, ReportedFault

SAMPLES = "(float[1,8,4,4] x, float[1,3,5,2] g, float[1,1,3,5] w) => (float[A,B,C] y)"
BODY = "s = GridSample(x, g) a = Softmax(w) m = Mul(s, a) y = ReduceSum<keepdims=0>"
AXES = "<int64[1] last = {-1}>"
ATTENTION = "(float16[1,9,8] q, float16[1,8,9] k, float16[1,9,8] v) => (float16[A] y)"
CLIPPED = "(float[2,3] x, float[3,4] w, float[4] b) => (float[2,4] y)"
BOUNDS = "<float zero = {0.0}, float six = {6.0}, float one = {1.0}>"
IMAGE = "(float[1,2,4,4] x, float[1,3,3,2] g, bool c, float[4] r) => (float[A] y)"
HALF = "(float16[1,2,4,4] x, float16[1,3,3,2] g) => (float16[A] y)"
FLOAT = "(float[1,2,4,4] x, float[1,3,3,2] g) => (float[A] y)"
CHOSEN = (
    "t = If(c)<then_branch = a () => (float[1,4,4,2] u) { u = Identity(p) },"
    " else_branch = b () => (float[1,4,4,2] v) { v = Neg(p) }>"
)
INT8 = (
    "<int8[4,4] i = {1,1,1,1,1,1,1,1,1,1,1,1,1,1,1,1}, float s = {0.5}, int8 z = {0}>"
)
PAIR = "a = QuantizeLinear(x, s, z) b = DequantizeLinear(a, s, z)"

FOUND = {
    "grid-sample-mode": (20, FLOAT, 'y = GridSample<mode="linear">(x, g)'),
    "decomposed-attention": (17, f"{SAMPLES} {AXES}", f"{BODY}(m, last)"),
    "float32-grid-sample": (
        17,
        HALF,
        "a = Cast<to=1>(x) b = Cast<to=1>(g) c = GridSample(a, b) y = Cast<to=10>(c)",
    ),
    "clip-bound": (
        17,
        f"{CLIPPED} {BOUNDS}",
        "m = MatMul(x, w) a = Add(b, m) y = Clip(a, zero, six)",
    ),
    "resize-of-if": (
        17,
        IMAGE,
        f"p = Transpose<perm=[0,2,3,1]>(x) {CHOSEN}"
        " n = Transpose<perm=[0,3,1,2]>(t) y = Resize(n, , r)",
    ),
    "half-attention": (
        17,
        ATTENTION,
        "p = MatMul(q, k) t = Mul(p, p) a = Softmax(t) y = MatMul(a, v)",
    ),
    "attention-keys": (
        17,
        "(float16[1,65536] x) => (float16[1,65536] y)",
        "y = Softmax(x)",
    ),
    "half-variance": (
        17,
        "(float16[2,8] x) => (float16[2,1] y) <int64 two = {2}>",
        "p = Pow(x, two) y = ReduceMean<axes=[-1]>(p)",
    ),
    "modulated-convolution": (
        17,
        "(float[1,2,4,4] x) => (float[A] y)",
        "y = trt.ModulatedDeformableConv2dTRT(x)",
    ),
    "int8-product": (
        17,
        f"(float[2,4] x) => (float[2,4] y) {INT8}",
        f"{PAIR} w = DequantizeLinear(i, s, z) y = MatMul(b, w)",
    ),
    "bfloat16-deconvolution": (
        17,
        "(bfloat16[1,1,4,4] x, bfloat16[1,1,2,2] w) => (bfloat16[A] y)",
        "y = ConvTranspose(x, w)",
    ),
    "broadcast-product": (
        17,
        "(float[1,6,1,1,4,4] x, float[1,1,10,30,4,1] w) => (float[1,6,10,30,4,1] y)",
        "y = MatMul(x, w)",
    ),
    "strided-softmax": (
        17,
        "(float[1,7200,8] x) => (float[1,7200,8] y)",
        "y = Softmax<axis=-2>(x)",
    ),
}
"""Rule -> opset, signature and body of a graph that has it."""

NOT_FOUND = {
    "grid-sample-mode": (
        (20, FLOAT, "y = GridSample(x, g)"),  # the parser's default is bilinear
        (20, FLOAT, 'y = GridSample<mode="nearest">(x, g)'),
        (17, FLOAT, 'y = GridSample<mode="bilinear">(x, g)'),
    ),
    "decomposed-attention": (
        (17, f"{SAMPLES} {AXES}", BODY.replace("Softmax", "Sigmoid") + "(m, last)"),
        (17, SAMPLES, "s = GridSample(x, g) a = Softmax(w) y = Mul(s, a)"),
    ),
    "float32-grid-sample": (
        (17, HALF, "y = GridSample(x, g)"),
        (17, FLOAT, "y = GridSample(x, g)"),
    ),
    "clip-bound": (
        (17, f"{CLIPPED} {BOUNDS}", "m = MatMul(x, w) y = Clip(m, zero, six)"),
        (
            17,
            f"{CLIPPED} {BOUNDS}",
            "m = MatMul(x, w) a = Add(b, m) y = Clip(a, one, six)",
        ),
        (17, f"{CLIPPED} {BOUNDS}", "m = MatMul(x, w) a = Add(b, m) y = Clip(a, zero)"),
    ),
    "resize-of-if": ((17, IMAGE, "y = Resize(x, , r)"),),
    "half-attention": (
        (17, ATTENTION.replace("float16", "float"), FOUND["half-attention"][2]),
        (17, ATTENTION, "a = Softmax(q) y = MatMul(a, k)"),
    ),
    "attention-keys": (
        (17, "(float16[1,65504] x) => (float16[1,65504] y)", "y = Softmax(x)"),
        (17, "(float[1,65536] x) => (float[1,65536] y)", "y = Softmax(x)"),
    ),
    "half-variance": (
        (
            17,
            "(float[2,8] x) => (float[2,1] y) <int64 two = {2}>",
            FOUND["half-variance"][2],
        ),
        (
            17,
            "(float16[2,8] x, float16[2,8] z) => (float16[2,1] y)",
            "p = Mul(x, z) y = ReduceMean<axes=[-1]>(p)",
        ),
    ),
    "modulated-convolution": (
        (17, "(float[2] x) => (float[2] y)", "y = trt.ModulatedDeformConv2d(x)"),
    ),
    "int8-product": (
        (17, f"(float[2,4] x, float[4,4] w) => (float[2,4] y) {INT8}",
         f"{PAIR} y = MatMul(b, w)"),
    ),
    "bfloat16-deconvolution": (
        (17, "(float16[1,1,4,4] x, float16[1,1,2,2] w) => (float16[A] y)",
         "y = ConvTranspose(x, w)"),
    ),
    "broadcast-product": (
        (17, "(float[1,6,9,9,4,4] x, float[1,6,9,9,4,1] w) => (float[1,6,9,9,4,1] y)",
         "y = MatMul(x, w)"),
        (17, "(float[1,6,1,1,4,4] x, float[1,6,9,9,4,1] w) => (float[1,6,9,9,4,1] y)",
         "y = MatMul(x, w)"),
        (17, "(float[6,1,4,4] x, float[1,30,4,1] w) => (float[6,30,4,1] y)",
         "y = MatMul(x, w)"),
    ),
    "strided-softmax": (
        (17, "(float[1,8,7200] x) => (float[1,8,7200] y)", "y = Softmax(x)"),
        (17, "(float[1,312,8] x) => (float[1,312,8] y)", "y = Softmax<axis=1>(x)"),
    ),
}  # fmt: skip
"""Rule -> graphs that are nearly so."""


def rules(opset: int, signature: str, body: str, version: str = "") -> set[str]:
    head = f'<ir_version: 10, opset_import: ["" : {opset}, "trt" : 1]>'
    model = ir.from_onnx_text(f"{head} m {signature} {{ {body} }}")
    names = {each.rule for each in FAULTS}
    return {each.rule for each in TensorRT(version=version).lint(model)} & names


def row(rule: str) -> ReportedFault:
    (found,) = (each for each in FAULTS if each.rule == rule)
    return found


def test_every_row_has_a_graph_of_its_own_and_one_that_is_nearly_so() -> None:
    names = [each.rule for each in FAULTS]
    assert names == list(FOUND) == list(NOT_FOUND)


@pytest.mark.parametrize("rule", FOUND)
def test_a_pattern_is_found(rule: str) -> None:
    assert rule in rules(*FOUND[rule])


@pytest.mark.parametrize(
    ("rule", "graph"),
    [(rule, each) for rule, many in NOT_FOUND.items() for each in many],
)
def test_what_is_nearly_the_pattern_is_not(
    rule: str, graph: tuple[int, str, str]
) -> None:
    assert rule not in rules(*graph)


def test_attention_is_told_once_whatever_its_levels() -> None:
    _, signature, body = FOUND["decomposed-attention"]
    two = body.replace(
        "m = Mul(s, a)", "t = GridSample(x, g) j = Concat<axis=1>(s, t) m = Mul(j, a)"
    )
    head = '<ir_version: 10, opset_import: ["" : 17]>'
    model = ir.from_onnx_text(f"{head} m {signature} {{ {two} }}")

    found = [each.rule for each in TensorRT().lint(model)]

    assert found.count("decomposed-attention") == 1


@pytest.mark.parametrize(
    ("rule", "version", "concerns"),
    [
        ("decomposed-attention", "10.13", False),
        ("decomposed-attention", "10.14", True),
        ("decomposed-attention", "10.14.1.48", True),
        ("decomposed-attention", "11.1", True),
        # nobody says that a later one is better: the thread is open
        ("decomposed-attention", "11.4", True),
        ("clip-bound", "10.11", False),
        ("clip-bound", "10.12", True),
        # on one board with 8.6 alone
        ("broadcast-product", "8.5", False),
        ("broadcast-product", "8.6.1", True),
        ("broadcast-product", "10.0", False),
        # no version is told
        ("strided-softmax", "8.6", True),
    ],
)
def test_a_version_has_what_is_reported_of_it(
    rule: str, version: str, concerns: bool
) -> None:
    assert (rule in rules(*FOUND[rule], version)) == concerns


@pytest.mark.parametrize("each", FAULTS, ids=lambda each: each.rule)
def test_a_row_names_versions_thread_and_remedy(each: ReportedFault) -> None:
    assert each.what in each.message
    assert each.remedy in each.message
    assert f"{each.versions}, {each.source}" in each.message
    # a thread by its number, or a file of a repository
    assert "#" in each.source or each.source.endswith(".md")
    assert dataclasses.replace(each, first="", last="").concerns((8, 6))


def test_the_page_lists_every_row_with_its_versions() -> None:
    page = (Path(__file__).parents[3] / "docs" / "quantization.md").read_text("utf-8")
    told = re.findall(r"^`([\w-]+)` \| ([^|]+) \|", page, re.MULTILINE)
    rows = [(each.rule, each.versions.removeprefix("TensorRT ")) for each in FAULTS]
    assert [each for each in told if each[0] in FOUND] == rows


@pytest.mark.parametrize("text", ["10", "10.x", "ten", "10.13.3.9.1", "v10.13", "10."])
def test_a_version_that_is_none(text: str) -> None:
    with pytest.raises(ValueError, match="is no version of TensorRT, such as"):
        TensorRT(version=text)


@pytest.mark.parametrize(
    ("version", "severity"),
    [("", "warning"), ("10.14", "error"), ("10.15", None), ("11.2", None)],
)
def test_an_operator_that_came_later(version: str, severity: str | None) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 10, opset_import: ["" : 23]>'
        "m (float[2,4] x, float[4] s) => (float[2,4] y) { y = RMSNormalization(x, s) }"
    )
    found = {
        each.severity
        for each in TensorRT(version=version).lint(model)
        if each.rule == "operator"
    }
    assert found == ({severity} if severity else set())
