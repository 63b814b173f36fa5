import onnx_ir as ir
import pytest

from me2e_compress.base.errors import RecipeError
from me2e_compress.targets import TARGETS
from me2e_compress.targets.quantized import describe_quantized

GRID = (
    '<ir_version: 9, opset_import: ["" : %d]>'
    "m (float[1,1,4,4] x, float[1,2,2,2] g) => (float[1,1,2,2] y)"
    " { y = GridSample(x, g) }"
)


@pytest.mark.parametrize("target", TARGETS.names())
def test_operators_younger_than_the_graph(target: str) -> None:
    found = TARGETS.parse(target).lint(ir.from_onnx_text(GRID % 13))

    young = [each.message for each in found if each.rule == "operator-of-opset"]
    assert young == ["GridSample came with opset 16, the graph is of 13"]
    assert not TARGETS.parse(target).lint(ir.from_onnx_text(GRID % 16))


PROJECTED = """<ir_version: 9, opset_import: ["" : 16]>
m (float[1,1,4,4] x, float[1,2,2,2] p, float[1,2,2,1] depth, bool[1] near)
    => (float[1,1,2,2] y)
    <float eps = {{1e-5}}, float minus = {{-1}}, float half = {{2}}>
{{
    {guard}
    [project] uv = {division}
    scaled = Mul(uv, half)
    grid = {last}
    y = GridSample(x, grid)
}}
"""


@pytest.mark.parametrize(
    ("guard", "division", "last", "is_told"),
    [
        ("d = Identity(depth)", "Div(p, d)", "Sub(scaled, eps)", True),
        ("r = Reciprocal(depth)", "Mul(p, r)", "Identity(scaled)", True),
        ("d = Max(depth, minus)", "Div(p, d)", "Identity(scaled)", True),
        ("d = Clip(depth, minus)", "Div(p, d)", "Identity(scaled)", True),
        ("d = Mul(depth, eps)", "Div(p, d)", "Identity(scaled)", True),
        ("d = Max(depth, eps)", "Div(p, d)", "Identity(scaled)", False),
        ("d = Clip(depth, eps)", "Div(p, d)", "Identity(scaled)", False),
        ("d = Add(eps, depth)", "Div(p, d)", "Identity(scaled)", False),
        ("d = Where(near, depth, eps)", "Div(p, d)", "Identity(scaled)", False),
        ("e = Exp(depth) d = Mul(e, eps)", "Div(p, d)", "Identity(scaled)", False),
        ("", "Div(p, half)", "Identity(scaled)", False),
        ("d = Identity(depth)", "Div(p, d)", "Where(near, scaled, eps)", False),
    ],
)
@pytest.mark.parametrize("target", TARGETS.names())
def test_divisions_on_the_way_to_a_grid(
    target: str, guard: str, division: str, last: str, is_told: bool
) -> None:
    text = PROJECTED.format(guard=guard, division=division, last=last)

    found = TARGETS.parse(target).lint(ir.from_onnx_text(text))

    told = [each for each in found if each.rule == "divided-grid"]
    assert [each.severity for each in told] == ["warning"] * is_told
    assert all("by which it divides, may be 0, and GridS" in e.message for e in told)


@pytest.mark.parametrize("target", TARGETS.names())
def test_what_is_no_valid_graph(target: str) -> None:
    model = ir.from_onnx_text(GRID % 16)
    model.graph[0].attributes.add(ir.AttrInt64("speed", 3))

    (found,) = TARGETS.parse(target).lint(model)

    assert (found.severity, found.rule) == ("error", "onnx")
    assert "speed" in found.message


def test_no_such_target() -> None:
    with pytest.raises(RecipeError, match="no target 'qnn'; there are tensorrt"):
        TARGETS.parse("qnn").lint(ir.from_onnx_text(GRID % 16))


# Graphs that somebody has quantized already.


HEAD = '<ir_version: 9, opset_import: ["" : 17, "com.microsoft" : 1]>\n'


VECTOR = "m (float[2] x) => (float[2] y)"
PAIR = "{ q = QuantizeLinear(x, s%s) y = DequantizeLinear(q, s%s) }"
COUNTED = "1 DequantizeLinear, 1 QuantizeLinear; "


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (f"{VECTOR} {{ y = Relu(x) }}", None),
        (
            f"{VECTOR} <float s = {{0.5}}, int8 z = {{0}}> {PAIR % (', z', ', z')}",
            f"{COUNTED}int8 with zero points 0; made by onnx.quantize",
        ),
        (
            f"{VECTOR} <float s = {{0.5}}, uint8 z = {{128}}> {PAIR % (', z', ', z')}",
            f"{COUNTED}uint8 with zero points that are not 0; made by onnx.quantize",
        ),
        (
            f"{VECTOR} <float s = {{0.5}}> {PAIR % ('', '')}",
            f"{COUNTED}uint8 with zero points 0; made by onnx.quantize",
        ),
        (
            f"{VECTOR} <float s = {{0.5}}, int8[2] q = {{-3, 4}}>"
            " { w = DequantizeLinear(q, s) y = Add(x, w) }",
            "1 DequantizeLinear; int8 with zero points 0; made by onnx.quantize",
        ),
        (
            f"{VECTOR} <float s = {{0.5}}> {PAIR % ('', '')}".replace(
                "QuantizeLinear(x", "QuantizeLinear<output_dtype=3>(x", 1
            ),
            f"{COUNTED}int8 with zero points 0; made by onnx.quantize",
        ),
        (  # an integer operator of a runtime
            "m (float[2,2] x, int8[2,2] w, float s) => (float[2,2] y)"
            " { y = com.microsoft.DynamicQuantizeMatMul(x, w, s) }",
            "1 DynamicQuantizeMatMul; made by onnx.quantize",
        ),
    ],
)
def test_what_is_quantized_says_its_grid_and_its_maker(
    text: str, said: str | None
) -> None:
    model = ir.from_onnx_text(HEAD + text)
    model.producer_name = "onnx.quantize"

    assert describe_quantized(model) == said
