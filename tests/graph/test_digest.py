from collections.abc import Callable

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph

TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[2,3] x) => (float[3,2] y)
<float[3] w = {1.0, 2.0, 3.0}> {
    a = Add(x, w)
    y = Transpose<perm=[1,0]>(a)
}
"""


def changed_weight(model: ir.Model) -> None:
    data = np.array([1.0, 2.0, 4.0], np.float32)
    model.graph.initializers["w"].const_value = ir.tensor(data, name="w")


def changed_attribute(model: ir.Model) -> None:
    model.graph[1].attributes["perm"] = ir.AttrInt64s("perm", [0, 1])


def changed_edge(model: ir.Model) -> None:
    model.graph[0].replace_input_with(1, model.graph.inputs[0])


def changed_past(model: ir.Model) -> None:
    model.graph[0].metadata_props["me2e.module"] = "planner"


def changed_output(model: ir.Model) -> None:
    model.graph.outputs[0].name = "z"


@pytest.mark.parametrize(
    "change",
    [
        changed_weight,
        changed_attribute,
        changed_edge,
        changed_past,
        changed_output,
    ],
)
def test_every_change_shows(change: Callable[[ir.Model], None]) -> None:
    model = ir.from_onnx_text(TEXT)
    before = graph.digest(model)
    change(model)
    assert graph.digest(model) != before


def test_a_clone_has_the_same_digest() -> None:
    model = ir.from_onnx_text(TEXT)
    assert graph.digest(model.clone()) == graph.digest(model)


def test_a_branch_is_part_of_the_graph() -> None:
    text = (
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "m (bool c, float[2] x) => (float[2] y) {"
        " y = If(c) <then_branch = t () => (float[2] a) { a = Relu(x) },"
        " else_branch = e () => (float[2] b) { b = OP(x) }> }"
    )
    negated = ir.from_onnx_text(text.replace("OP", "Neg"))
    absolute = ir.from_onnx_text(text.replace("OP", "Abs"))
    assert graph.digest(negated) != graph.digest(absolute)
