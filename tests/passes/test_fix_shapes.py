"""Open dimensions that are given a size."""

from collections.abc import Mapping

import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import Me2eError, PreconditionError, RecipeError
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.manager import PassManager, Report, recipe
from me2e_compress.passes import Context
from me2e_compress.passes.fix_shapes import FixShapes, with_sizes

OPEN = """
<ir_version: 9, opset_import: ["" : 17]>
open (float[batch,3,side,side] image, float["2*batch",4] pairs)
    => (float[batch,rest] y, float[twice,4] z) <int64[1] minus = {-1}, int64 zero = {0}>
{
    s = Shape(image)
    b = Gather(s, zero)
    r = Reshape(b, minus)
    full = Concat<axis=0>(r, minus)
    y = Reshape(image, full)
    z = Relu(pairs)
}
"""


def fixed(sizes: Mapping[str, int], text: str = OPEN) -> Report:
    passes = with_sizes(recipe.load("exact"), sizes)
    model = ir.from_onnx_text(text)
    return PassManager(passes).run(model, Context(ModuleMap.whole()))


def test_sizes_make_every_shape_static_and_its_arithmetic_foldable() -> None:
    report = fixed({"batch": 2, "side": 4})
    model = report.model
    shapes = [str(port.shape) for port in (*model.graph.inputs, *model.graph.outputs)]
    assert shapes == ["[2,3,4,4]", "[4,4]", "[2,48]", "[4,4]"]
    assert [node.op_type for node in model.graph] == ["Reshape", "Relu"]
    (check,) = report.verifications
    assert check.inputs == "synthetic"
    assert check.passes[:2] == ("import-normalize", "fix-shapes")
    again = FixShapes({"batch": 2}).run(model, Context(ModuleMap.whole()))
    assert again.changes == 0


def test_a_dimension_that_is_not_named_stays_open() -> None:
    model = fixed({"batch": 2}).model
    assert str(model.graph.inputs[0].shape) == "[2,3,side,side]"
    assert model.metadata_props["me2e.fixed"] == '{"batch": 2}'


def test_a_question_mark_is_no_name_and_each_place_has_its_size() -> None:
    text = """<ir_version: 9, opset_import: ["" : 17]>
        g (float[1,"?","?"] x) => (float[1,"?","?"] y) { y = Relu(x) }"""
    for named in (text, text.replace('"?"', "?")):  # or without a name
        model = fixed({"x:1": 3, "x:2": 5}, named).model
        assert [str(value.shape) for value in model.graph.outputs] == ["[1,3,5]"]
    with pytest.raises(PreconditionError, match=r"called '\?'; there is x:1, x:2"):
        fixed({"?": 3}, text)


def test_sizes_belong_to_inputs_and_a_wrong_output_follows() -> None:
    """Runtimes take an output of another size, or rank, with a warning."""
    for stated in ("n", "n,2"):
        text = f"""<ir_version: 9, opset_import: ["" : 17]>
            g (float[n,6] x) => (float[{stated}] y) <int64[1] minus = {{-1}}>
            {{ s = Sigmoid(x) y = Reshape(s, minus) }}"""
        model = fixed({"n": 1}, text).model
        assert [str(value.shape) for value in model.graph.outputs] == ["[6]"]


REFUSES = """<ir_version: 9, opset_import: ["" : 17]>
m (float[n,3] x, float[4,5] w) => (float[3,5] y) { t = Transpose(x) y = MatMul(t, w) }
"""


@pytest.mark.parametrize(
    ("sizes", "text", "message"),
    [
        ({"btch": 1}, OPEN, "called 'btch'; there is batch, side"),
        ({"n": 1}, REFUSES, "the graph refuses n=1"),
    ],
)
def test_sizes_that_do_not_fit(sizes: dict[str, int], text: str, message: str) -> None:
    with pytest.raises(PreconditionError, match=message):
        fixed(sizes, text)


@pytest.mark.parametrize("text", ["fix-shapes", "fix-shapes{dims={}}"])
def test_a_pass_without_sizes_is_an_error(text: str) -> None:
    with pytest.raises(RecipeError, match="fix-shapes needs"):
        recipe.parse(text)


def test_sizes_are_1_or_more() -> None:
    with pytest.raises(Me2eError, match="batch=0 must be 1 or more"):
        FixShapes({"batch": 0})


def test_sizes_are_written_in_a_pipeline_and_read_back() -> None:
    passes = (FixShapes({"batch": 1, "a::b_dim_0": 2, "image:0": 3}),)
    assert recipe.parse(recipe.to_text(passes)) == passes


def test_shapes_that_an_exporter_recorded_for_a_plugin_are_given_the_size() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>\n'
        "m (float[batch,3] x) => (float[batch,3] y) {"
        " a = trt.Rotate(x) y = Relu(a) }"
    )
    model.graph[0].outputs[0].shape = ir.Shape(["batch", 3])
    model.graph[0].outputs[0].type = ir.TensorType(ir.DataType.FLOAT)
    FixShapes({"batch": 2}).run(model, Context(ModuleMap.whole()))
    assert graph.static_shape(model.graph[0].outputs[0]) == (2, 3)
