import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import PreconditionError, RecipeError
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.passes.fused_nodes import ExpandOperators, TranslatePlugins
from me2e_compress.passes.import_normalize import with_own_domains
from tests.passes.small import NO_MODULES, apply, compute, ops, read

OPSET = """<ir_version: 9, opset_import: ["" : 17, "trt.plugins" : 1, "mmdeploy" : 1]>
"""
RAW = (
    OPSET
    + """
net (float[1,8,2,3] v, float[1,4,1,2] points, float[1,4,2,8] offsets,
     float[1,4,2,4] raw) => (float[1,4,2,3] y)
    <int32[2,2] sizes = {2, 3, 1, 2}> {
    a = Relu(v)
    y = MultiScaleDeformableAttnTRT(a, sizes, points, offsets, raw)
}
"""
)
TWO = (
    OPSET
    + """
net (float[1,8,2,3] v, float[1,4,2,2,2,2] at, float[1,4,2,2,2] w)
    => (float[1,4,6] y)
    <int32[2,2] sizes = {2, 3, 1, 2}, int32[2] starts = {0, 6}> {
    a = trt.plugins.MultiscaleDeformableAttnPlugin_TRT(v, sizes, starts, at, w)
    b = mmdeploy.MMCVMultiScaleDeformableAttention<im2col_step = 32>
        (a_rows, sizes, starts, at, w)
    y = Neg(b)
}
""".replace("a_rows", "v")
)


def feeds(model: ir.Model) -> dict[str, np.ndarray]:
    random = np.random.default_rng(3)
    return {
        str(port.name): random.uniform(0.1, 0.9, port.shape.numpy()).astype(np.float32)
        for port in model.graph.inputs
        if port.shape is not None
    }


def test_plugins_of_two_libraries_become_standard_operators() -> None:
    model = read(TWO)
    result = apply(ExpandOperators(), model)
    assert result.notes == ("expanded: 2 deformable-attention",)
    assert "GridSample" in ops(model)
    assert list(model.graph.opset_imports) == [""]


def test_the_output_keeps_its_name_and_nodes_their_past() -> None:
    model = read(RAW)
    apply(ExpandOperators(), model)
    assert model.graph.outputs[0].name == "y"
    assert '"n1"' in model.graph[-1].metadata_props["me2e.origins"]


def test_a_graph_in_one_dialect_gives_what_it_gave() -> None:
    model, other = read(RAW), read(RAW)
    apply(TranslatePlugins("tensorrt"), other)
    (node,) = (each for each in other.graph if each.domain)
    assert node.op_identifier() == (
        "trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", ""
    )  # fmt: skip
    assert node.attributes.get_string("plugin_version", "") == "1"
    assert [value.dtype for value in node.inputs[1:3] if value] == [
        ir.DataType.INT32
    ] * 2
    for each in (model, other):
        apply(ExpandOperators(), each)
    (want,), (got,) = (compute(each, feeds(each)) for each in (model, other))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)


def test_a_round_trip_gives_what_it_gave_and_no_domain_in_the_file() -> None:
    model, other = read(RAW), read(RAW)
    apply(TranslatePlugins("autoware"), other)
    apply(TranslatePlugins("derryhub"), other)
    (node,) = (each for each in other.graph if each.domain)
    assert node.domain == PLUGIN_DOMAIN
    assert node.metadata_props[ORIGINAL_DOMAIN] == ""
    back = with_own_domains(other).graph
    (written,) = (each for each in back if "TRT" in each.op_type)
    assert (written.domain, written.op_type) == ("", "MultiScaleDeformableAttnTRT")
    for each in (model, other):
        apply(ExpandOperators(), each)
    (want,), (got,) = (compute(each, feeds(each)) for each in (model, other))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)


def test_a_name_of_no_dialect_is_an_error() -> None:
    with pytest.raises(RecipeError, match="no dialect 'trt'; there are me2e, tensorrt"):
        TranslatePlugins("trt")


def test_an_operator_that_the_library_lacks_is_named() -> None:
    text = (
        OPSET
        + """
    net (float[1,6,4,4] x) => (float[1,6,4,4] y) { ["turn"] y = InverseTRT(x) }"""
    )
    with pytest.raises(
        PreconditionError,
        match=r"node turn: the dialect tensorrt has no inverse \(InverseTRT\)",
    ):
        TranslatePlugins("tensorrt").run(read(text), NO_MODULES)


def test_an_opset_that_is_too_old_is_an_error() -> None:
    model = read(RAW.replace('"" : 17', '"" : 12'))
    with pytest.raises(PreconditionError, match="needs opset 13"):
        ExpandOperators().run(model, NO_MODULES)


def test_plugins_nobody_knows_stay() -> None:
    model = read(OPSET + "net (float[2] x) => (float[2] y) { y = mmdeploy.What(x) }")
    assert ExpandOperators().run(model, NO_MODULES).changes == 0
    assert TranslatePlugins("tensorrt").run(model, NO_MODULES).changes == 0
