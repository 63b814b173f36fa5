"""Whatever a graph gives out, an edit leaves its interface and its answers alone."""

from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from onnx.reference import ReferenceEvaluator

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph import rewrite
from me2e_compress.manager.attempt import check_valid
from tests.support.nets import parsed
from tests.support.profiles import scaled

X = np.array([[-2.0, 0.5, 3.0]], np.float32)


@st.composite
def models(draw: st.DrawFn) -> ir.Model:
    """Draw a few nodes in a row, any of whose values the graph may give out."""
    known = ["x", "w"]
    lines = []
    for index in range(draw(st.integers(1, 6))):
        op = draw(st.sampled_from(["Identity", "Identity", "Neg", "Relu", "Add"]))
        count = 2 if op == "Add" else 1
        names = [draw(st.sampled_from(known)) for _ in range(count)]
        known.append(f"v{index}")
        lines.append(f"v{index} = {op}({', '.join(names)})")
    made = known[2:]
    outputs = draw(st.lists(st.sampled_from(made), min_size=1, unique=True))
    ports = ", ".join(f"float[1,3] {name}" for name in outputs)
    return parsed(
        f"g (float[1,3] x) => ({ports})\n"
        "<float[1,3] w = {1.0, -1.0, 2.0}> {\n" + "\n".join(lines) + "\n}"
    )


def answers(model: ir.Model) -> list[Any]:
    return list(ReferenceEvaluator(ir.to_proto(model)).run(None, {"x": X}))


def hold(model: ir.Model, ports: object, expected: list[Any]) -> None:
    assert graph.interface(model) == ports
    check_valid("the edit", model)
    for got, want in zip(answers(model), expected, strict=True):
        np.testing.assert_array_equal(got, want)


@settings(max_examples=scaled(40))
@given(models(), st.data())
def test_put(model: ir.Model, data: st.DataObject) -> None:
    ports, expected = graph.interface(model), answers(model)
    node = data.draw(st.sampled_from(list(model.graph)))

    zero = rewrite.add_constant(model.graph, np.zeros((1, 3), np.float32), "v0")
    doubled = rewrite.put(node, node.op_type, node.inputs, by="test")
    rewrite.put(doubled, doubled.op_type, doubled.inputs, by="test")

    hold(model, ports, expected)
    assert zero.name != "v0"


@settings(max_examples=scaled(40))
@given(models())
def test_bypass_and_remove_dead(model: ir.Model) -> None:
    ports, expected = graph.interface(model), answers(model)

    for node in list(model.graph):
        source = node.inputs[0]
        if node.op_type == "Identity" and source is not None:
            rewrite.bypass(node.outputs[0], source)
            hold(model, ports, expected)
    rewrite.remove_dead(model.graph)

    hold(model, ports, expected)
    assert rewrite.remove_dead(model.graph) == 0


@settings(max_examples=scaled(40))
@given(models(), st.data())
def test_replace_value_keeps_the_interface(
    model: ir.Model, data: st.DataObject
) -> None:
    ports, expected = graph.interface(model), answers(model)
    old = data.draw(st.sampled_from(list(model.graph.outputs)))
    inputs = [*model.graph.inputs, *model.graph.initializers.values()]
    new = data.draw(st.sampled_from(inputs))

    with pytest.raises(GraphError, match=f"output {old.name} cannot be made of"):
        rewrite.replace_value(old, new)

    hold(model, ports, expected)


TWO_OUTPUTS = """
g (float[2,3] x) => (float[1,3] y) {
    a, b = Split(x)
    y = Add(a, b)
}
"""


def test_a_node_whose_other_outputs_are_read_is_not_replaced() -> None:
    model = parsed(TWO_OUTPUTS)
    before = graph.digest(model)
    split = model.graph[0]

    with pytest.raises(GraphError, match="cannot be replaced: b is read too"):
        rewrite.put(split, "Relu", split.inputs, by="test")

    assert graph.digest(model) == before


CALLED_REPLACED = """
g (float[1,3] x) => (float[1,3] y, float[1,3] y_replaced) {
    a = Neg(x)
    y = Identity(a)
    y_replaced = Relu(y)
}
"""


def test_the_value_that_was_an_output_takes_a_free_name() -> None:
    model = parsed(CALLED_REPLACED)
    neg, identity, _ = model.graph
    ports = graph.interface(model)
    onnx.checker.check_model(ir.to_proto(model))

    assert rewrite.bypass(identity.outputs[0], neg.outputs[0])

    assert graph.interface(model) == ports
    check_valid("the edit", model)
