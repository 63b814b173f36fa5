"""Functions of graphsurgeon, run as passes of ours."""

import dataclasses

import numpy as np
import onnx_graphsurgeon as gs
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import PassError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.passes.foreign import SurgeonFunction
from me2e_compress.testing import check_pass
from tests.passes.small import NO_MODULES


@pytest.fixture
def model() -> ir.Model:
    made = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17]>'
        "g (float[2] x) => (float[2] y) { a = Relu(x) b = Relu(a) y = Neg(b) }"
    )
    for node, module in zip(made.graph, ("neck", "det", "planner"), strict=True):
        node.name = f"n_{node.outputs[0].name}"
        provenance.stamp(node, Provenance(module, (node.name,)))
    return made


def drop_second_relu(surgeon: gs.Graph) -> None:
    first, second, last = surgeon.nodes
    last.inputs = first.outputs
    second.outputs.clear()
    surgeon.cleanup(recurse_functions=False)


def test_the_pass_is_frozen_and_calls_the_function(model: ir.Model) -> None:
    current = SurgeonFunction(drop_second_relu, name="drop-second-relu")
    before = graph.digest(model)
    result = current.run(model, NO_MODULES)
    assert graph.digest(model) == before
    assert [node.name for node in result.model.graph] == ["n_a", "n_y"]
    assert [provenance.module_of(n) for n in result.model.graph] == ["neck", "planner"]
    assert result.changes == 1
    with pytest.raises(dataclasses.FrozenInstanceError):
        current.name = "other"  # type: ignore[misc]


def test_new_nodes_of_a_returned_graph_have_a_module(model: ir.Model) -> None:
    def insert(surgeon: gs.Graph) -> gs.Graph:
        twin = surgeon.copy()
        last = twin.nodes[-1]
        added = gs.Variable("added", np.float32, [2])
        new = gs.Node("Abs", "mine", inputs=[last.inputs[0]], outputs=[added])
        twin.nodes = [*twin.nodes, new]
        last.inputs[0] = added
        return twin

    result = SurgeonFunction(insert, name="insert-abs").run(model, NO_MODULES)
    by_name = {node.name: provenance.read(node) for node in result.model.graph}
    assert by_name["mine"] == Provenance("det", ("n_b",), ("insert-abs",))
    assert by_name["n_y"] == Provenance("planner", ("n_y",))


def test_a_node_with_another_attribute_names_the_pass() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17]>'
        "g (float[2,2] x) => (float[2,2] y) { a = Relu(x) y = Softmax<axis = 0>(a) }"
    )

    def turn(surgeon: gs.Graph) -> None:
        surgeon.nodes[1].attrs["axis"] = 1

    relu, softmax = check_pass(SurgeonFunction(turn, name="turn"), model).model.graph

    pasts = [provenance.read(node) for node in (relu, softmax)]
    assert [past and past.passes for past in pasts] == [(), ("turn",)]


def test_a_function_that_does_nothing_changes_nothing(model: ir.Model) -> None:
    result = SurgeonFunction(lambda surgeon: None, name="idle").run(model, NO_MODULES)
    assert result.changes == 0
    assert result.model is model


def test_a_function_that_returns_something_else_is_refused(model: ir.Model) -> None:
    def count(surgeon: gs.Graph) -> int:
        return len(surgeon.nodes)

    current = SurgeonFunction(count, name="count")  # pyright: ignore[reportArgumentType]
    with pytest.raises(PassError, match="count returned a int, not a graph or None"):
        current.run(model, NO_MODULES)
