from pathlib import Path

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.surgeon import from_graphsurgeon, to_graphsurgeon

TEXT = """
<ir_version: 8, opset_import: ["": 17, "f": 1]>
g (bool c, float[2] x) => (float[2] y)
<float[2] w = {1.0, 2.0}>
{
  a = Add (x, w)
  b = f.Scale (a)
  d = f.Half (b)
  y = If (c) <
    then_branch = t () => (float[2] p) { p = Relu (d) },
    else_branch = e () => (float[2] q) { q = Neg (d) }
  >
}
<domain: "f", opset_import: ["": 17]>
Scale (i) => (o) { o = Add (i, i) }
<domain: "f", opset_import: ["": 17]>
Half (i) => (o) { k = Constant <value = float {0.5}> ()  o = Mul (i, k) }
"""


@pytest.fixture
def model() -> ir.Model:
    made = ir.from_onnx_text(TEXT)
    for node in made.graph.all_nodes():
        node.name = f"n_{node.outputs[0].name}"
        past = provenance.Provenance(f"module of {node.name}", (node.name,))
        provenance.stamp(node, past)
        node.metadata_props["namespace"] = f"scope of {node.name}"
    for function in made.functions.values():
        function.metadata_props["me2e.kind"] = "fallback"
        for node in function:
            node.name = f"inner_{node.outputs[0].name}"
            node.metadata_props["note"] = "kept"
    made.metadata_props["me2e.stack"] = "vad-tiny"
    made.graph.initializers["w"].metadata_props["folded"] = "bn"
    return made


def test_there_and_back_changes_nothing(model: ir.Model) -> None:
    back = from_graphsurgeon(to_graphsurgeon(model), model)
    assert graph.digest(back) == graph.digest(model)
    assert graph.interface(back) == graph.interface(model)
    assert back.ir_version == model.ir_version
    # functions keep their metadata
    assert list(back.functions) == [("f", "Scale", ""), ("f", "Half", "")]
    half = back.functions["f", "Half", ""]
    assert half.metadata_props == {"me2e.kind": "fallback"}
    assert all(n.metadata_props == {"note": "kept"} for n in half if n.name)
    onnx.checker.check_model(ir.to_proto(back))
    # so do initializers and bodies
    assert back.graph.initializers["w"].metadata_props == {"folded": "bn"}
    inner = {n.name: n.metadata_props["namespace"] for n in back.graph.all_nodes()}
    assert [inner[n] for n in ("n_p", "n_q")] == ["scope of n_p", "scope of n_q"]


def test_the_model_itself_is_not_touched(model: ir.Model, tmp_path: Path) -> None:
    before = graph.digest(model)
    graph.save(model, tmp_path / "m.onnx", external=True)
    stored = to_graphsurgeon(graph.load(tmp_path / "m.onnx"))
    np.testing.assert_array_equal(stored.tensors()["w"].values, [1, 2])
    handed = to_graphsurgeon(model)
    handed.nodes = list(reversed(handed.nodes))
    back = from_graphsurgeon(handed, model)
    assert [node.name for node in back.graph] == ["n_a", "n_b", "n_d", "n_y"]
    handed = to_graphsurgeon(model)
    handed.nodes[0].op = "Sub"
    handed.nodes[0].inputs[1].values = np.zeros(2, np.float32)
    assert graph.digest(model) == before


@pytest.mark.parametrize("fault", ["a cycle", "an output without a type"])
def test_what_is_no_model_is_refused(model: ir.Model, fault: str) -> None:
    handed = to_graphsurgeon(model)
    if fault == "a cycle":
        handed.nodes[0].inputs[0] = handed.nodes[1].outputs[0]
    else:
        handed.outputs = [handed.nodes[0].outputs[0]]
    with pytest.raises(
        GraphError, match=r"^recipe: graphsurgeon's graph is not a"
    ) as c:
        from_graphsurgeon(handed, model, by="recipe")
    assert "\n" not in str(c.value)


def test_an_overload_is_refused(model: ir.Model) -> None:
    function = model.functions.pop(("f", "Half", ""))
    function.overload = "half"
    model.functions[function.identifier()] = function
    with pytest.raises(GraphError, match="graphsurgeon knows no overloads, as of Half"):
        to_graphsurgeon(model)
