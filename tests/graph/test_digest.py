from collections.abc import Callable

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress import graph

TEXT = """
<ir_version: 9, opset_import: ["" : 17]>
m (float[2,3] x, bool c) => (float[3,2] y)
<float[3] w = {1.0, 2.0, 3.0}> {
    a = Add(x, w)
    b = Transpose<perm=[1,0]>(a)
    y = If(c) <then_branch = t () => (float[3,2] t) { t = Relu(b) },
               else_branch = e () => (float[3,2] e) { e = Neg(b) }>
}
"""


def weight(model: ir.Model) -> None:
    data = np.array([1.0, 2.0, 4.0], np.float32)
    model.graph.initializers["w"].const_value = ir.tensor(data, name="w")


def branch(model: ir.Model) -> ir.Graph:
    return model.graph[2].attributes["else_branch"].as_graph()


CHANGES: dict[str, Callable[[ir.Model], object]] = {
    "weight": weight,
    "attribute": lambda m: m.graph[1].attributes.add(ir.AttrInt64s("perm", [0, 1])),
    "edge": lambda m: m.graph[0].replace_input_with(1, m.graph.inputs[0]),
    "past": lambda m: m.graph[0].metadata_props.update({"me2e.module": "planner"}),
    "branch": lambda m: setattr(branch(m)[0], "op_type", "Abs"),
    "output": lambda m: setattr(m.graph.outputs[0], "name", "z"),
}


@pytest.mark.parametrize("change", CHANGES)
def test_every_change_shows(change: str) -> None:
    model = ir.from_onnx_text(TEXT)
    before = graph.digest(model)
    assert graph.digest(model.clone()) == before
    CHANGES[change](model)
    assert graph.digest(model) != before
