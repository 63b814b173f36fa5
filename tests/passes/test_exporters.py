"""Graphs as exporters write them go through `exact` and answer the same."""

from pathlib import Path

import onnx
import onnx_ir as ir
from onnx import TensorProto, helper

from me2e_compress import graph
from me2e_compress.graph.modules import ModuleMap
from me2e_compress.manager import PassManager, Report, recipe
from me2e_compress.passes import Context

STANDARD, OWN = helper.make_opsetid("", 17), helper.make_opsetid("my", 1)
PORTS = [
    helper.make_tensor_value_info(name, TensorProto.FLOAT, [2, 8]) for name in "xy"
]


def exact(model: ir.Model) -> Report:
    """Run the recipe; the manager proves that the outputs are the same."""
    return PassManager(recipe.load("exact")).run(model, Context(ModuleMap.whole()))


def test_a_function_may_import_its_own_domain() -> None:
    body = [
        helper.make_node("Mul", ["a", "a"], ["s"]),
        helper.make_node("Add", ["s", "a"], ["b"]),
    ]
    function = helper.make_function("my", "Bend", ["a"], ["b"], body, [STANDARD, OWN])
    nodes = [
        helper.make_node("Bend", ["x"], ["t"], domain="my"),
        helper.make_node("Bend", ["t"], ["y"], domain="my"),
    ]
    held = helper.make_graph(nodes, "g", PORTS[:1], PORTS[1:])
    proto = helper.make_model(
        held, opset_imports=[STANDARD, OWN], functions=[function], ir_version=9
    )
    onnx.checker.check_model(proto, full_check=True)

    result = exact(ir.serde.deserialize_model(proto))

    assert [node.op_type for node in result.model.graph] == ["Bend", "Bend"]
    again = exact(result.model)
    assert not any(step.changes for step in again.steps)


def test_the_standard_domain_may_have_its_name(tmp_path: Path) -> None:
    nodes = [
        helper.make_node("Relu", ["x"], ["r"], domain="ai.onnx"),
        helper.make_node("Softmax", ["r"], ["y"], domain="ai.onnx"),
    ]
    held = helper.make_graph(nodes, "g", PORTS[:1], PORTS[1:])
    opsets = [helper.make_opsetid("ai.onnx", 17)]
    onnx.save(
        helper.make_model(held, opset_imports=opsets, ir_version=8),
        tmp_path / "m.onnx",
    )

    result = exact(graph.load(tmp_path / "m.onnx"))

    assert [node.domain for node in result.model.graph] == ["", ""]
    assert result.model.opset_imports == {"": 17}
