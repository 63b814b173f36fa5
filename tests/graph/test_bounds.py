"""What a graph claims is bounded before anybody goes through all of it."""

from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest
from onnx import TensorProto, helper

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph.shapes import can_carry, infer_shapes, static_shape
from me2e_compress.graph.summary import macs
from me2e_compress.manager.equivalence import random_outputs
from tests.calls import calls

OPSETS = [helper.make_opsetid("", 17), helper.make_opsetid("own", 1)]


def port(name: str, *shape: int) -> onnx.ValueInfoProto:
    return helper.make_tensor_value_info(name, TensorProto.FLOAT, shape)


def saved(body: onnx.GraphProto, path: Path, *functions: onnx.FunctionProto) -> Path:
    model = helper.make_model(
        body, functions=functions, opset_imports=OPSETS, ir_version=9
    )
    onnx.save(model, path)
    return path


def calling(count: int, times: int, path: Path) -> Path:
    """Write a graph of functions, each of which calls the next so many times."""
    functions = [helper.make_function("own", f"f{count}", ["a0"], ["y"], [], OPSETS)]
    functions[0].node.append(helper.make_node("Relu", ["a0"], ["y"]))
    for at in range(count):
        nodes = [
            helper.make_node(f"f{at + 1}", [f"a{i}"], [f"a{i + 1}"], domain="own")
            for i in range(times)
        ]
        made = (["a0"], [f"a{times}"], nodes, OPSETS)
        functions.append(helper.make_function("own", f"f{at}", *made))
    first = helper.make_node("f0", ["x"], ["y"], domain="own")
    body = helper.make_graph([first], "g", [port("x", 4)], [port("y", 4)])
    return saved(body, path, *functions)


@pytest.mark.parametrize(
    ("count", "times", "message"),
    [
        (30, 2, "make 1,073,741,824 nodes of it, 1,000,000"),
        (400, 1, "call each other more than 32 deep"),
    ],
)
def test_functions_beyond_the_bounds_are_not_read(
    tmp_path: Path, count: int, times: int, message: str
) -> None:
    with pytest.raises(GraphError, match=message):
        graph.load(calling(count, times, tmp_path / "m.onnx"))
    assert len(graph.load(calling(12, 2, tmp_path / "m.onnx")).functions) == 13


def nested(depth: int) -> ir.Model:
    """Return a Scan of a Scan of ... of a Relu."""
    node, shape = helper.make_node("Relu", ["a0"], ["b0"]), [4]
    for at in range(1, depth + 1):
        ports = [port(f"a{at - 1}", *shape)], [port(f"b{at - 1}", *shape)]
        body = helper.make_graph([node], f"body{at}", *ports)
        node = helper.make_node(
            "Scan", [f"a{at}"], [f"b{at}"], body=body, num_scan_inputs=1
        )
        shape = [1, *shape]
    ports = [port(f"a{depth}", *shape)], [port(f"b{depth}", *shape)]
    whole = helper.make_graph([node], "g", *ports)
    return ir.from_proto(helper.make_model(whole, opset_imports=OPSETS, ir_version=9))


def test_macs_and_draws_of_nested_loops_take_a_walk_a_level() -> None:
    model = nested(16)
    (scan,) = model.graph
    assert (macs(scan), random_outputs(model)) == (0, ())
    assert calls(lambda: macs(scan)) < 20_000
    assert calls(lambda: random_outputs(model)) < 20_000


DOUBLED = """
<ir_version: 9, opset_import: ["" : 17]>
g (float[1024] x) => (float[n] y) {{
    {}
    y = Relu(c{})
}}
"""


def doubled(times: int) -> ir.Model:
    """Return a graph of Concats, each of the one before twice."""
    lines = [f"c{at + 1} = Concat<axis = 0>(c{at}, c{at})" for at in range(times)]
    return ir.from_onnx_text(DOUBLED.format("\n".join(["c0 = Relu(x)", *lines]), times))


def test_vectors_that_double_are_not_carried_along() -> None:
    model = doubled(30)
    assert not can_carry(model.graph)
    infer_shapes(model)
    assert static_shape(model.graph[30].outputs[0]) == (1024 << 30,)
    assert can_carry(doubled(4).graph)
    made = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "g () => (int64[n] y) <int64[1] size = {9999999999}> {"
        " a = ConstantOfShape(size) y = Cast<to = 7>(a) }"
    )
    assert not can_carry(made.graph)


def with_tensors(path: Path) -> Path:
    """Write a plugin whose attribute is a list of tensors that lie in a file."""
    tensor = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=[3])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="k.data")
    node = helper.make_node("Foo", ["x"], ["y"], domain="own", name="foo")
    node.attribute.add(
        name="tables", type=onnx.AttributeProto.TENSORS, tensors=[tensor]
    )
    body = helper.make_graph([node], "g", [port("x", 3)], [port("y", 3)])
    return saved(body, path)


def test_tensors_of_a_list_are_read_from_their_file(tmp_path: Path) -> None:
    path = with_tensors(tmp_path / "m.onnx")
    with pytest.raises(GraphError, match=r"k\.data is missing"):
        graph.load(path)
    np.arange(3, dtype=np.float32).tofile(tmp_path / "k.data")
    model = graph.load(path)
    (tensor,) = model.graph[0].attributes["tables"].as_tensors()
    assert tensor.numpy().tolist() == [0, 1, 2]
    assert graph.digest(model)
