"""What a graph claims is bounded before anybody goes through all of it."""

from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest
from onnx import TensorProto

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.shapes import can_propagate, infer_shapes, static_shape
from me2e_compress.graph.summary import macs
from me2e_compress.manager.equivalence import random_outputs
from tests.support.calls import calls
from tests.support.nets import parsed

OPSETS = 'opset_import: ["" : 17, "own" : 1]'


def calling(count: int, times: int, path: Path) -> Path:
    """Write a graph of functions, each of which calls the next so many times."""
    text = f"<ir_version: 9, {OPSETS}>\n"
    text += "g (float[4] x) => (float[4] y) { y = own.f0(x) }"
    for at in range(count + 1):
        asked = [f"a{i + 1} = own.f{at + 1}(a{i})" for i in range(times)]
        body = " ".join(asked if at < count else [f"a{times} = Relu(a0)"])
        text += f'\n<domain: "own", {OPSETS}>\nf{at} (a0) => (a{times}) {{ {body} }}'
    onnx.save(onnx.parser.parse_model(text), path)
    return path


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
    body, shape = "b0 = Relu(a0)", "4"
    for at in range(1, depth + 1):
        ports = f"(float[{shape}] a{at - 1}) => (float[{shape}] b{at - 1})"
        body = f"""b{at} = Scan<num_scan_inputs = 1, body = body{at} {ports}
            {{ {body} }}>(a{at})"""
        shape = f"1,{shape}"
    return parsed(
        f"g (float[{shape}] a{depth}) => (float[{shape}] b{depth}) {{ {body} }}"
    )


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
    assert not can_propagate(model.graph)
    infer_shapes(model)
    assert static_shape(model.graph[30].outputs[0]) == (1024 << 30,)
    assert can_propagate(doubled(4).graph)
    made = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 17]>\n'
        "g () => (int64[n] y) <int64[1] size = {9999999999}> {"
        " a = ConstantOfShape(size) y = Cast<to = 7>(a) }"
    )
    assert not can_propagate(made.graph)


def with_tensors(path: Path) -> Path:
    """Write a plugin whose attribute is a list of tensors that lie in a file."""
    tensor = TensorProto(name="k", data_type=TensorProto.FLOAT, dims=[3])
    tensor.data_location = TensorProto.EXTERNAL
    tensor.external_data.add(key="location", value="k.data")
    model = onnx.parser.parse_model(
        f"<ir_version: 9, {OPSETS}>"
        'g (float[3] x) => (float[3] y) { ["foo"] y = own.Foo(x) }'
    )
    model.graph.node[0].attribute.add(
        name="tables", type=onnx.AttributeProto.TENSORS, tensors=[tensor]
    )
    onnx.save(model, path)
    return path


def test_tensors_of_a_list_are_read_from_their_file(tmp_path: Path) -> None:
    path = with_tensors(tmp_path / "m.onnx")
    with pytest.raises(GraphError, match=r"k\.data is missing"):
        graph.load(path)
    np.arange(3, dtype=np.float32).tofile(tmp_path / "k.data")
    model = graph.load(path)
    (tensor,) = model.graph[0].attributes["tables"].as_tensors()
    assert tensor.numpy().tolist() == [0, 1, 2]
    assert graph.digest(model)
