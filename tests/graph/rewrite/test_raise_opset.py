"""Every operator that changed before opset 13 answers the same after it was raised."""

from typing import Any

import numpy as np
import onnx
import onnx_ir as ir
import onnxruntime as ort
import pytest
from onnx import TensorProto, helper

from me2e_compress.graph import provenance
from me2e_compress.graph.nodes import nodes_of
from me2e_compress.passes import Context
from me2e_compress.passes.import_normalize import ImportNormalize
from tests.passes.small import EVERYTHING

SHAPE = [1, 4, 8, 8]
OPERATORS: dict[str, tuple[int, dict[str, Any], tuple[list[float], ...], int]] = {
    "Softmax": (11, {"axis": 1}, (), 1),
    "LogSoftmax": (12, {"axis": 3}, (), 1),
    "Unsqueeze": (11, {"axes": [0, 5]}, (), 1),
    "Split": (11, {"axis": 1, "split": [1, 3]}, (), 2),
    "ReduceSum": (11, {"axes": [1], "keepdims": 0}, (), 1),
    "ReduceMean": (9, {"axes": [-1]}, (), 1),
    "Clip": (7, {"min": -0.5, "max": 0.5}, (), 1),
    "Pad": (9, {"pads": [0, 0, 1, 2, 0, 0, 3, 4], "value": 2.0}, (), 1),
    "Slice": (9, {"starts": [1, 2], "ends": [3, -1], "axes": [1, 2]}, (), 1),
    "Upsample": (8, {"scales": [1.0, 1.0, 2.0, 3.0], "mode": "linear"}, (), 1),
    "Upsample of": (9, {"mode": "nearest"}, ([1.0, 1.0, 2.0, 1.5],), 1),
    "Resize": (10, {"mode": "linear"}, ([1.0, 1.0, 1.6, 1.0],), 1),
    "Resize larger": (10, {"mode": "nearest"}, ([1.0, 1.0, 1.6, 1.3],), 1),
    "Resize smaller": (10, {"mode": "nearest"}, ([1.0, 1.0, 0.6, 0.7],), 1),
    "Dropout": (7, {"ratio": 0.5}, (), 1),
    "BatchNormalization": (8, {}, ([1, 2, 3, 4], [1, 0, 1, 0], [0] * 4, [4] * 4), 1),
    "TopK": (9, {"k": 3, "axis": 1}, (), 2),
}


def old_graph(op: str) -> onnx.ModelProto:
    """Build one node of an old opset, behind a Relu whose plugin-free name is kept."""
    opset, attributes, more, outputs = OPERATORS[op]
    weights = [
        helper.make_tensor(f"w{place}", TensorProto.FLOAT, [len(each)], each)
        for place, each in enumerate(more)
    ]
    names = [f"y{place}" for place in range(outputs)]
    inputs = ["r", *(weight.name for weight in weights)]
    operator = op.partition(" ")[0]
    nodes = [
        helper.make_node("Tanh", ["x"], ["r"], name="tanh"),
        helper.make_node(operator, inputs, names, name="old", **attributes),
    ]
    x = helper.make_tensor_value_info("x", TensorProto.FLOAT, SHAPE)
    ports = [onnx.ValueInfoProto(name=name) for name in names]
    graph = helper.make_graph(nodes, "g", [x], ports, weights)
    imports = [helper.make_opsetid("", opset)]
    return helper.make_model(graph, opset_imports=imports, ir_version=8)


@pytest.mark.parametrize("op", OPERATORS)
def test_a_graph_of_an_old_opset_answers_the_same(op: str) -> None:
    proto = onnx.shape_inference.infer_shapes(old_graph(op))
    x = np.random.default_rng(3).normal(size=SHAPE).astype(np.float32)
    expected = ort.InferenceSession(proto.SerializeToString()).run(None, {"x": x})
    model = ir.serde.deserialize_model(proto)

    ImportNormalize().run(model, Context(EVERYTHING))

    raised = ir.serde.serialize_model(model)
    assert raised.opset_import[0].version == 13
    onnx.checker.check_model(raised, full_check=True)
    answers = ort.InferenceSession(raised.SerializeToString()).run(None, {"x": x})
    for one, other in zip(expected, answers, strict=True):
        np.testing.assert_allclose(
            np.asarray(one), np.asarray(other), rtol=1e-6, atol=1e-6
        )
    assert all(provenance.read(node) is not None for node in nodes_of(model))


@pytest.mark.parametrize(
    ("op", "row"),
    [
        ("Hardmax", (11, {"axis": 2}, (), 1)),
        ("Resize", (10, {"mode": "nearest"}, ([1.0, 1.0, 1.6, 0.7],), 1)),
    ],
)
def test_what_the_converter_would_change_stays_in_its_opset(
    op: str, row: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(OPERATORS, op, row)
    model = ir.serde.deserialize_model(old_graph(op))

    result = ImportNormalize().run(model, Context(EVERYTHING))

    assert model.opset_imports[""] == row[0]
    assert f"opset {row[0]} stays: {op} 'old' stays as it is" in result.notes[0]


@pytest.mark.parametrize(
    ("body", "opset", "note"),
    [
        ("MatMul(i, i)", 13, "opset 12 became 13"),
        (
            "Softmax(i)",
            12,
            "opset 12 stays: Softmax 'Softmax_0' of a function is another there",
        ),
    ],
)
def test_functions_are_converted_too(body: str, opset: int, note: str) -> None:
    model = ir.from_onnx_text(
        '<ir_version: 9, opset_import: ["" : 12, "f" : 1]> g (float[2,2] x) =>'
        " (float[2,2] y) { h = f.F(x) y = MatMul(h, x) }"
        f' <domain: "f", opset_import: ["" : 12]> F (i) => (o) {{ o = {body} }}'
    )

    result = ImportNormalize().run(model, Context(EVERYTHING))

    (function,) = model.functions.values()
    assert model.opset_imports[""] == function.opset_imports[""] == opset
    assert result.notes == (note,)
    onnx.checker.check_model(ir.to_proto(model))
