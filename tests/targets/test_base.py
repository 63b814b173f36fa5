import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
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


def read(text: str) -> ir.Model:
    return ir.from_onnx_text(HEAD + text)


def test_a_float_graph_is_not() -> None:
    model = read("m (float[2] x) => (float[2] y) { y = Relu(x) }")

    assert describe_quantized(model) is None


@pytest.mark.parametrize(
    ("zero", "grid"),
    [
        ("int8 z = {0}", "int8 with zero points 0"),
        ("uint8 z = {128}", "uint8 with zero points that are not 0"),
    ],
)
def test_pairs_say_their_grid(zero: str, grid: str) -> None:
    model = read(
        f"m (float[2] x) => (float[2] y) <float s = {{0.5}}, {zero}>"
        " { q = QuantizeLinear(x, s, z) y = DequantizeLinear(q, s, z) }"
    )
    assert describe_quantized(model) == (
        f"1 DequantizeLinear, 1 QuantizeLinear; {grid}"
    )


def test_integer_operators_of_a_runtime_are_counted_and_the_maker_named() -> None:
    model = read(
        "m (float[2,2] x, int8[2,2] w, float s) => (float[2,2] y)"
        " { y = com.microsoft.DynamicQuantizeMatMul(x, w, s) }"
    )
    model.producer_name = "onnx.quantize"

    assert describe_quantized(model) == (
        "1 DynamicQuantizeMatMul; made by onnx.quantize"
    )


def test_a_pair_without_a_zero_point_is_uint8() -> None:
    model = read(
        "m (float[2] x) => (float[2] y) <float s = {0.5}>"
        " { q = QuantizeLinear(x, s) y = DequantizeLinear(q, s) }"
    )
    assert "uint8 with zero points 0" in str(describe_quantized(model))
