from pathlib import Path

import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.documents import MalformedError
from me2e_compress.base.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import ORIGINS, PASSES, Provenance
from tests.support.nets import parsed


@pytest.fixture
def node() -> ir.Node:
    node = ir.node("Relu", [ir.val("x")], name="/occ/Relu")
    provenance.stamp(node, Provenance("occ", ("a", "b"), ("fuse-basic",)))
    return node


def _model(
    inputs: list[ir.Value], outputs: list[ir.Value], nodes: list[ir.Node]
) -> ir.Model:
    made = ir.Graph(inputs, outputs, nodes=nodes, opset_imports={"": 17})
    return ir.Model(made, ir_version=8)


def test_a_past_is_read_as_it_was_stamped(node: ir.Node) -> None:
    assert provenance.read(node) == Provenance("occ", ("a", "b"), ("fuse-basic",))


@pytest.mark.parametrize("text", ["", "{", "3", '{"a": 1}', "[1]", '["a", null]'])
def test_a_past_of_another_kind_is_named(node: ir.Node, text: str) -> None:
    node.metadata_props[ORIGINS] = text
    with pytest.raises(GraphError, match=r"^node /occ/Relu: its metadata me2e"):
        provenance.read(node)


def test_a_file_holds_few_bytes_of_the_past_and_loses_but_passes(
    tmp_path: Path,
) -> None:
    pasts = {"a": ("a",), "b": ("source/of/a", "source/of/b"), "c": ("a",)}
    model = parsed(
        "m (float[2] x) => (float[2] w) {"
        " t = Relu (x) u = Relu (t) v = Relu (u) w = Relu (v) }"
    )
    nodes = list(model.graph)
    for node, name in zip(nodes, (*pasts, "c"), strict=True):  # two bear one name
        node.name = name
        provenance.stamp(node, Provenance("m", pasts[name], ("p",)))
    before = [dict(node.metadata_props) for node in nodes]

    graph.save(model, tmp_path / "m.onnx")

    assert [list(each.items()) for each in before] == [
        list(node.metadata_props.items()) for node in nodes
    ]
    assert not model.metadata_props
    written = onnx.load(tmp_path / "m.onnx")
    stored = [{each.key for each in node.metadata_props} for node in written.graph.node]
    assert [ORIGINS in keys for keys in stored] == [False, False, True, True]
    read = graph.load(tmp_path / "m.onnx")
    kept = [PASSES in keys for keys in stored]
    assert kept == [False, False, True, True]
    assert [
        {key: text for key, text in props.items() if keep or key != PASSES}
        for props, keep in zip(before, kept, strict=True)
    ] == [dict(node.metadata_props) for node in read.graph]
    assert not read.metadata_props


@pytest.mark.parametrize("others", [("m", "m"), ("m", "other")])
def test_a_module_that_all_nodes_share_is_written_once(
    others: tuple[str, str], tmp_path: Path
) -> None:
    model = parsed("m (float[2] x) => (float[2] w) { t = Relu (x) w = Relu (t) }")
    for node, name, module in zip(model.graph, "ab", others, strict=True):
        node.name = name
        provenance.stamp(node, Provenance(module, (name,)))
    graph.save(model, tmp_path / "m.onnx")

    written = onnx.load(tmp_path / "m.onnx")
    shared = len(set(others)) == 1
    assert [bool(node.metadata_props) for node in written.graph.node] == [
        not shared
    ] * 2
    pasts = [provenance.read(node) for node in graph.load(tmp_path / "m.onnx").graph]
    assert pasts == [Provenance(m, (n,)) for m, n in zip(others, "ab", strict=True)]


@pytest.mark.parametrize("text", ["eJyr", "!", "[1]", '{"a": ', "[" * 300])
def test_a_past_that_is_no_table_is_named(text: str) -> None:
    model = parsed("m (float[2] x) => (float[2] w) { w = Relu (x) }")
    model.metadata_props[ORIGINS] = text
    with pytest.raises(GraphError, match=r"^its metadata me2e.origins is not a table"):
        provenance.unpack(model)


def test_a_text_beyond_the_bound_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    text = "abc" * 1000
    assert provenance.decompressed(provenance.compressed(text)) == text
    monkeypatch.setattr(provenance, "_LARGEST", 2999)
    with pytest.raises(MalformedError, match="too long"):
        provenance.decompressed(provenance.compressed(text))
