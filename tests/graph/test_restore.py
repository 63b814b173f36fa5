import onnx_ir as ir

from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.graph.surgeon import restore


def read(body: str, **modules: str) -> ir.Model:
    """Make a model; nodes are named n_<output> and stamped where a module is given."""
    model = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17]>'
        f"g (float[2] x, float[2] w) => (float[2] y) {{ {body} }}"
    )
    for node in model.graph.all_nodes():
        output = node.outputs[0].name or ""
        node.name = f"n_{output}"
        if output in modules:
            provenance.stamp(node, Provenance(modules[output], (node.name,)))
    return model


LIKE = read(
    "a = Add(x, w) b = Mul(a, w) c = Relu(b) y = Neg(c)",
    a="neck",
    b="neck",
    c="det",
    y="planner",
)


def pasts(model: ir.Model) -> dict[str | None, Provenance | None]:
    return {n.outputs[0].name: provenance.read(n) for n in model.graph.all_nodes()}


def test_nodes_are_known_by_their_output_whatever_they_are_called() -> None:
    model = read("a = Add(x, w) b = Mul(a, w) c = Relu(b) y = Neg(c)")
    for node in model.graph:
        node.name = f"renamed_{node.name}"
    LIKE.graph[0].metadata_props["namespace"] = "neck: N/add: aten.add"
    restore(model, LIKE, by="tool")
    assert pasts(model) == pasts(LIKE)
    assert model.graph[0].metadata_props["namespace"] == "neck: N/add: aten.add"
    assert model.graph[0].name == "renamed_n_a"


def test_old_names_come_back_on_request() -> None:
    model = read("a = Add(x, w) y = Sub(a, w)")
    for node in model.graph:
        node.name = f"renamed_{node.name}"
    restore(model, LIKE, by="tool", node_names=True)
    assert [node.name for node in model.graph] == ["n_a", "renamed_n_y"]


def test_nodes_are_known_by_their_name_if_their_output_was_renamed() -> None:
    model = read("a = Add(x, w) b2 = Mul(a, w) c = Relu(b2) y = Neg(c)")
    model.graph[1].name = "n_b"
    restore(model, LIKE, by="tool")
    assert pasts(model)["b2"] == Provenance("neck", ("n_b",))


def test_a_fused_node_stands_for_what_vanished_and_a_new_one_goes_along() -> None:
    model = read("s = Exp(w) a = Add(x, w) t = Abs(a) c = Sum(t, s) y = Neg(c)")
    restore(model, LIKE, by="tool")
    assert pasts(model)["c"] == Provenance("det", ("n_c", "n_b"), ("tool",))
    assert pasts(model)["t"] == Provenance("neck", ("n_a",), ("tool",))
    assert pasts(model)["s"] == Provenance("det", ("n_c", "n_b"), ("tool",))
    assert provenance.missing(model) == []


def test_metadata_of_the_model_and_of_values_comes_back_and_new_stays() -> None:
    like = read("y = Relu(x)", y="neck")
    like.metadata_props.update({"me2e.stack": "vad-tiny", "kept": "old"})
    like.graph[0].outputs[0].metadata_props["scale"] = "0.5"
    model = read("y = Relu(x)")
    model.metadata_props["kept"] = "new"
    restore(model, like, by="tool")
    assert model.metadata_props == {"me2e.stack": "vad-tiny", "kept": "new"}
    assert model.graph[0].outputs[0].metadata_props == {"scale": "0.5"}
