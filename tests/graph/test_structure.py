"""What is refused where a graph is read, each fault in one line that names it."""

from collections.abc import Callable
from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph.shapes import open_shape
from me2e_compress.runtime.session import Session
from tests.fuzz.graphs import FAULTS, branch_graph, seed_graph

REFUSED = {
    "cycle": "not a valid ONNX graph .*cycle",
    "output-twice": "'a' is made twice: by node '/backbone/Reshape' and by node",
    "input-twice": "graph: input 'image' is there twice",
    "initializer-twice": "initializer 'tokens' is there twice",
    "input-is-made": "'image' is made twice: .* by an input or initializer",
    "no-initializer-name": "initializer without a name",
    "no-op-type": "has no operator or no output",
    "unknown-input": "node '/backbone/Relu' reads 'nowhere', which nothing makes",
    "unknown-output": "output 'nowhere': nothing makes it",
    "sparse": "initializer 's' is sparse",
    "function-recursive": "function twice calls itself",
    "functions-in-a-circle": "calls itself, at once or over others",
    "function-twice": "two of its functions have one name",
    "opset-negative": "opset -5 of ai.onnx",
    "ir-0": "IR version 0",
    "dims-negative": r"initializer 'w' has shape \[-4, 3, 3, 3\]",
    "dims-huge": "too many elements",
    "raw-short": r"initializer 'w' has shape \[4, 3, 3, 3\]: ",
    "dim-huge": "'image' has a dimension of 4611686018427387904",
    "type-99": "initializer 'w' is of element type 99, which is none",
    "input-untyped": "'image' is not a tensor: its type is missing",
    "axis-float": r"\(Softmax\): .*: axis'. Expected: 'INT', actual: 'FLOAT'",
    "perm-wrong": r"perm \[0, 7, -9\] is none",
    "attribute-refers": "refers to one of a function, and stands in none",
    "too-many-inputs": r"\(Conv\): .* not in range \[min=2, max=3\]",
    "no-inputs-of-a-node": "has input size 0 not in range",
    "input-left-out": "input 0 is marked single but has an empty string",
}


@pytest.mark.parametrize("fault", REFUSED)
def test_a_fault_is_named_where_the_graph_is_read(tmp_path: Path, fault: str) -> None:
    model = seed_graph()
    FAULTS[fault](model)
    (tmp_path / "m.onnx").write_bytes(model.SerializeToString())

    with pytest.raises(GraphError, match=REFUSED[fault]) as caught:
        graph.load(tmp_path / "m.onnx")
    assert str(caught.value).startswith(f"{tmp_path}/m.onnx: ")
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("seed", [seed_graph, branch_graph])
def test_nodes_are_sorted(tmp_path: Path, seed: Callable[[], onnx.ModelProto]) -> None:
    model = seed()
    onnx.save(model, tmp_path / "in-order.onnx")
    nodes = list(model.graph.node)[::-1]
    del model.graph.node[:]
    model.graph.node.extend(nodes)
    onnx.save(model, tmp_path / "reversed.onnx")

    result = graph.load(tmp_path / "reversed.onnx")

    onnx.checker.check_model(ir.to_proto(result))
    assert {node.name for node in result.graph} == {node.name for node in nodes}


def test_a_size_below_zero_is_an_open_one_and_none_is_none(tmp_path: Path) -> None:
    model = seed_graph()
    sizes = model.graph.input[0].type.tensor_type.shape.dim
    sizes[0].dim_value, sizes[1].dim_value = -1, 0
    onnx.save(model, tmp_path / "m.onnx")

    loaded = graph.load(tmp_path / "m.onnx")

    assert open_shape(loaded.graph.inputs[0]) == (None, 0, 4, 4)


def test_a_plugin_takes_anything(tmp_path: Path) -> None:
    model = seed_graph()
    model.graph.node[1].op_type = "RotateTRT2"
    model.graph.node[1].attribute.add(name="interpolation", type=2, i=1)
    onnx.save(model, tmp_path / "m.onnx")

    assert graph.node_count(graph.load(tmp_path / "m.onnx")) == 10


DATA: dict[str, Callable[[bytes], onnx.TensorProto]] = {
    "raw_data": lambda data: onnx.TensorProto(raw_data=data),
    "int32_data": lambda data: onnx.TensorProto(int32_data=data),
}


@pytest.mark.parametrize("kind", [onnx.TensorProto.INT2, onnx.TensorProto.UINT2])
@pytest.mark.parametrize("field", DATA)
def test_weights_of_two_bits(tmp_path: Path, kind: int, field: str) -> None:
    model = onnx.parser.parse_model("""<ir_version: 13, opset_import: ["" : 25]>
        m (float[1,3] x, float s) => (float[1,3] y)
        { w = DequantizeLinear(q, s) y = MatMul(x, w) }""")
    weight = bytes([0b11_10_01_00, 0b00_01_10_11, 0b01])
    tensor = model.graph.initializer.add(name="q", data_type=kind, dims=[3, 3])
    tensor.MergeFrom(DATA[field](weight))
    path = tmp_path / "m.onnx"
    path.write_bytes(model.SerializeToString())

    sums = [4, 4, 5] if kind == onnx.TensorProto.UINT2 else [0, 0, -3]
    feeds = {"x": np.ones((1, 3), np.float32), "s": np.ones((), np.float32)}
    assert Session(graph.load(path)).run(feeds)["y"].tolist() == [sums]

    tensor.ClearField(field)
    tensor.raw_data = weight[:2]
    path.write_bytes(model.SerializeToString())
    with pytest.raises(GraphError, match="'q' has 2 bytes, its shape says 3"):
        graph.load(path)
