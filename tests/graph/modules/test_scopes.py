import onnx_ir as ir
import pytest

from me2e_compress.graph.modules.module_map import scope_of


def node(name: str, output: str = "", **props: str) -> ir.Node:
    made = ir.node("Relu", [ir.Value(name="x")], name=name)
    made.outputs[0].name = output
    made.metadata_props.update(props)
    return made


@pytest.mark.parametrize(
    ("name", "scope"),
    [
        ("/img_neck/Relu_3", "img_neck"),
        (
            "/img_backbone/layer1/layer1.0/conv1/Conv",
            "img_backbone.layer1.layer1.0.conv1",
        ),
        (
            "/head/cls_branches.0/cls_branches.0.3/MatMul",
            "head.cls_branches.0.cls_branches.0.3",
        ),
        ("model/conv/BiasAdd", "model.conv"),
        ("/Relu", ""),
        ("Relu_7", ""),
        ("", ""),
    ],
)
def test_torchscript_names(name: str, scope: str) -> None:
    assert scope_of(node(name)) == scope


def test_the_output_tells_where_a_tool_renamed_the_node() -> None:
    assert scope_of(node("Relu_7", "/img_neck/Relu_output_0")) == "img_neck"
    assert scope_of(node("/a/Relu", "/b/Relu_output_0")) == "a"


def test_dynamo_metadata() -> None:
    scopes = "['', 'head', 'head.decoder.1', 'div_35']"
    spaces = ": vad.VAD/head: vad.Head/head.decoder.1: vad.Layer/div_35: aten.div"
    flat = node("node_div_35", **{"pkg.torch.onnx.name_scopes": scopes})
    assert scope_of(flat) == "head.decoder.1"
    assert scope_of(node("node_div_35", namespace=spaces)) == "head.decoder.1"


@pytest.mark.parametrize("scopes", ["['']", "['', 'div']", "not a list", "{}", "['x'"])
def test_metadata_without_a_scope(scopes: str) -> None:
    flat = node("/a/div", **{"pkg.torch.onnx.name_scopes": scopes})
    assert scope_of(flat) == ""
