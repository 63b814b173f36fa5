import onnx_ir as ir
import pytest

from me2e_compress.errors import GraphError
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import ORIGINS, Provenance


@pytest.fixture
def node() -> ir.Node:
    node = ir.node("Relu", [ir.val("x")], name="/occ/Relu")
    provenance.stamp(node, Provenance("occ", ("a", "b"), ("fuse-basic",)))
    return node


def test_a_past_is_read_as_it_was_stamped(node: ir.Node) -> None:
    assert provenance.read(node) == Provenance("occ", ("a", "b"), ("fuse-basic",))


@pytest.mark.parametrize("text", ["", "{", "3", '{"a": 1}', "[1]", '["a", null]'])
def test_a_past_of_another_kind_is_named(node: ir.Node, text: str) -> None:
    node.metadata_props[ORIGINS] = text
    with pytest.raises(GraphError, match=r"^node /occ/Relu: its metadata me2e"):
        provenance.read(node)
