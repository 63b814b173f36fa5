import onnx_ir as ir
import pytest

from me2e_compress.errors import RecipeError
from me2e_compress.targets import TARGETS

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
