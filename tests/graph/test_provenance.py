from pathlib import Path

import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import ORIGINS, Provenance
from me2e_compress.registry.documents import MalformedError


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


def test_a_file_holds_few_bytes_of_the_past_and_loses_none(tmp_path: Path) -> None:
    pasts = {"a": ("a",), "b": ("source/of/a", "source/of/b"), "c": ("a",)}
    x = ir.val("x", ir.DataType.FLOAT, [2])
    nodes, last = [], x
    for name in (*pasts, "c"):  # the last two bear one name
        nodes.append(ir.node("Relu", [last], name=name))
        provenance.stamp(nodes[-1], Provenance("m", pasts[name], ("p",)))
        last = nodes[-1].outputs[0]
        last.name, last.type, last.shape = f"y{len(nodes)}", x.type, x.shape
    model = ir.Model(
        ir.Graph([x], [last], nodes=nodes, opset_imports={"": 17}), ir_version=8
    )
    before = [dict(node.metadata_props) for node in nodes]

    graph.save(model, tmp_path / "m.onnx")

    assert [list(each.items()) for each in before] == [
        list(node.metadata_props.items()) for node in nodes
    ]
    assert not model.metadata_props
    written = onnx.load(tmp_path / "m.onnx")
    held = [{each.key for each in node.metadata_props} for node in written.graph.node]
    assert [ORIGINS in keys for keys in held] == [False, False, True, True]
    read = graph.load(tmp_path / "m.onnx")
    assert [dict(node.metadata_props) for node in read.graph] == before
    assert not read.metadata_props


@pytest.mark.parametrize("text", ["eJyr", "!", "[1]", '{"a": ', "[" * 300])
def test_a_past_that_is_no_table_is_named(node: ir.Node, text: str) -> None:
    model = ir.Model(
        ir.Graph([], [], nodes=[node], opset_imports={"": 17}), ir_version=8
    )
    model.metadata_props[ORIGINS] = text
    with pytest.raises(GraphError, match=r"^its metadata me2e.origins is not a table"):
        provenance.unpack(model)


def test_a_text_of_more_than_its_bound_is_refused(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = "abc" * 1000
    assert provenance.decompressed(provenance.compressed(text)) == text
    monkeypatch.setattr(provenance, "_LARGEST", 2999)
    with pytest.raises(MalformedError, match="too long"):
        provenance.decompressed(provenance.compressed(text))
