import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.errors import PreconditionError
from me2e_compress.targets.tensorrt.rtx_check import cut

HEAD = '<ir_version: 9, opset_import: ["" : 17, "trt" : 1]>'
ROTATED = (
    HEAD + "m (float[2,4,4] x, float[1] a) => (float[2,4,4] y)"
    " <float[2] c = {1.0, 1.0}> { e = Relu(x) b = Neg(a)"
    ' ["/Rotate"] r = trt.RotateTRT<interpolation=1>(e, b, c) y = Exp(r) }'
)


def typed(text: str) -> ir.Model:
    """Read a graph; what plugins give has the shape of their first input."""
    model = ir.from_onnx_text(text)
    graph.infer_shapes(model)
    for node in model.graph:
        if node.domain == "trt" and node.inputs[0] is not None:
            node.outputs[0].shape = node.inputs[0].shape
            node.outputs[0].type = node.inputs[0].type
    return model


def test_what_a_plugin_reads_and_gives_become_outputs_and_inputs() -> None:
    part, gone = cut(typed(ROTATED))

    assert gone == ("/Rotate",)
    assert [node.op_type for node in part.graph] == ["Relu", "Neg", "Exp"]
    assert [value.name for value in part.graph.inputs] == ["x", "a", "r"]
    assert [value.name for value in part.graph.outputs] == ["y", "e", "b"]


def test_the_source_stays_whole() -> None:
    model = typed(ROTATED)
    before = graph.digest(model)

    cut(model)

    assert graph.digest(model) == before


def test_a_plugin_at_the_end_takes_its_output_along() -> None:
    model = typed(
        HEAD + "m (float[2,4,4] x) => (float[2,4,4] y)"
        " { e = Relu(x) y = trt.InverseTRT(e) }"
    )
    part, _ = cut(model)

    assert [value.name for value in part.graph.outputs] == ["e"]


def test_operators_that_only_tensorrt_has_are_cut_too() -> None:
    model = typed(
        HEAD.replace("17", "19")
        + "m (float[1,2,4,4] x, float[1,2,1,1] w, float[1,2,4,4] o) =>"
        " (float[1,1,4,4] y) { c = DeformConv(x, w, o) y = Relu(c) }"
    )
    _, gone = cut(model)

    assert gone == ("c",)


def test_a_local_function_is_no_plugin() -> None:
    text = """
    <ir_version: 9, opset_import: ["" : 17, "own" : 1]>
    m (float[2] x) => (float[2] y) { y = own.Twice(x) }
    <domain: "own", opset_import: ["" : 17]>
    Twice (x) => (y) { y = Add(x, x) }
    """
    part, gone = cut(ir.from_onnx_text(text))

    assert gone == ()
    assert len(part.functions) == 1


def test_a_plugin_of_unknown_result_cannot_be_cut_at() -> None:
    with pytest.raises(PreconditionError, match="output r is not known"):
        cut(ir.from_onnx_text(ROTATED))


def test_a_plugin_without_a_domain_is_cut_out_too() -> None:
    _, gone = cut(typed(ROTATED.replace("trt.Rotate", "Rotate")))
    assert gone == ("/Rotate",)
