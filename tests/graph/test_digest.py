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


def weight(model: ir.Model) -> None:
    data = np.array([1.0, 2.0, 4.0], np.float32)
    model.graph.initializers["w"].const_value = ir.tensor(data, name="w")


CHANGES: dict[str, Callable[[ir.Model], object]] = {
    "weight": weight,
    "attribute": lambda m: m.graph[1].attributes.add(ir.AttrInt64s("perm", [0, 1])),
    "edge": lambda m: m.graph[0].replace_input_with(1, m.graph.inputs[0]),
    "past": lambda m: m.graph[0].metadata_props.update({"me2e.module": "planner"}),
    "output": lambda m: setattr(m.graph.outputs[0], "name", "z"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_shows(change: str) -> None:
    model = ir.from_onnx_text(TEXT)
    before = graph.digest(model)
    assert graph.digest(model.clone()) == before
    CHANGES[change](model)
    assert graph.digest(model) != before


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
