"""Bodies of plugins, and plugins of libraries in standard operators."""

import numpy as np
import onnx_ir as ir
import onnxruntime
import pytest

from me2e_compress.base.errors import PreconditionError, RecipeError
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.operators.multi_head_attention import FusedMultiHeadAttention
from me2e_compress.passes.attach_bodies import AttachBodies
from me2e_compress.passes.base import Pass
from me2e_compress.passes.fused_nodes import ExpandOperators, TranslatePlugins
from me2e_compress.passes.import_normalize import with_own_domains
from me2e_compress.runtime.session import Session
from tests.passes.small import NO_MODULES, apply, compute, fed, ops, read

HEAD = """<ir_version: 9, opset_import: ["" : 17, "me2e" : 1, "mmdeploy" : 1]>
net (float[1,20,2,4] v, float[1,5,2,2,3,2] at, float[1,5,2,2,3] w, float[1,4,2,4] u)
"""
ALIKE = (
    HEAD
    + """ => (float[1,5,2,4] y) <int64[2,2] s = {4, 4, 2, 2}, int64[2] b = {0, 16}> {
    first = me2e.MultiScaleDeformableAttention(v, s, b, at, w)
    second = me2e.MultiScaleDeformableAttention(v, s, b, at, w)
    y = Add(first, second)
}"""
)
OF_OTHER_SIZES = (
    HEAD
    + """ => (float[1,5,2,4] y)
    <int64[2,2] s = {4, 4, 2, 2}, int64[2] b = {0, 16},
     int64[2,2] s2 = {1, 2, 1, 2}, int64[2] b2 = {0, 2}> {
    first = me2e.MultiScaleDeformableAttention(v, s, b, at, w)
    second = me2e.MultiScaleDeformableAttention(u, s2, b2, at, w)
    y = Add(first, second)
}"""
)
OF_TWO_COUNTS_OF_HEADS = """<ir_version: 9, opset_import: ["" : 17, "me2e" : 1]>
net (float[1,5,8] q) => (float[1,5,8] y) {
    once = me2e.MultiHeadAttention<heads = 4>(q, q, q)
    twice = me2e.MultiHeadAttention(once, once, once)
    y = me2e.MultiHeadAttention<heads = 4>(twice, twice, twice)
}"""
SIZES, STARTS = np.array([[4, 4], [2, 2]]), np.array([0, 16])


def drawn() -> dict[str, np.ndarray]:
    draws = np.random.default_rng(5)
    return {
        "v": draws.normal(size=(1, 20, 2, 4)).astype(np.float32),
        "at": draws.uniform(-0.2, 1.2, (1, 5, 2, 2, 3, 2)).astype(np.float32),
        "w": draws.random((1, 5, 2, 2, 3), np.float32),
        "u": draws.normal(size=(1, 4, 2, 4)).astype(np.float32),
    }


def in_plain_onnxruntime(model: ir.Model) -> np.ndarray:
    """Run a model where nobody knows our operators."""
    session = onnxruntime.InferenceSession(ir.to_proto(model).SerializeToString())
    (result,) = session.run(None, drawn())
    return np.asarray(result)


def reference(value: str, sizes: np.ndarray, starts: np.ndarray) -> np.ndarray:
    arrays = drawn()
    given = (arrays[value], sizes, starts, arrays["at"], arrays["w"])
    return DeformableAttention().reference(given, {})


OF_U = "u", np.array([[1, 2], [1, 2]]), np.array([0, 2])


@pytest.mark.parametrize(
    ("text", "second"), [(ALIKE, ("v", SIZES, STARTS)), (OF_OTHER_SIZES, OF_U)]
)
def test_nodes_share_a_body_that_any_runtime_runs(
    text: str, second: tuple[str, np.ndarray, np.ndarray]
) -> None:
    """Sizes that differ are read when it runs."""
    model = read(text)

    result = apply(AttachBodies(), model)

    assert result.notes == ("a body for 2 MultiScaleDeformableAttention",)
    (body,) = model.functions.values()
    assert "GridSample" in {node.op_type for node in body} or text is OF_OTHER_SIZES
    expected = reference("v", SIZES, STARTS) + reference(*second)
    np.testing.assert_allclose(in_plain_onnxruntime(model), expected, atol=1e-5)


def test_nodes_that_differ_in_attributes_get_a_body_each() -> None:
    model = read(OF_TWO_COUNTS_OF_HEADS)
    draws = np.random.default_rng(7)
    rows = draws.normal(size=(1, 5, 8)).astype(np.float32)

    result = apply(AttachBodies(), model)

    assert result.notes == ("2 bodies for 3 MultiHeadAttention",)
    session = onnxruntime.InferenceSession(ir.to_proto(model).SerializeToString())
    (found,) = session.run(None, {"q": rows})
    once = FusedMultiHeadAttention().reference([rows] * 3, {"heads": 4})
    twice = FusedMultiHeadAttention().reference([once] * 3, {"heads": 1})
    expected = FusedMultiHeadAttention().reference([twice] * 3, {"heads": 4})
    np.testing.assert_allclose(np.asarray(found), expected, atol=1e-5)
    assert model.ir_version == 10
    (kernels,) = compute(model, {"q": rows})
    np.testing.assert_allclose(kernels, expected, atol=1e-5)


def test_a_plugin_without_a_domain_stays_without() -> None:
    text = ALIKE.replace("me2e.Multi", "Multi").replace("Attention", "AttentionPlugin")
    text = text.replace("float[1,5,2,4] y", "float[1,5,8] y")
    text = text.replace("int64[2,2]", "int32[2,2]").replace("int64[2]", "int32[2]")
    result = apply(AttachBodies(), model := read(text))
    assert not model.functions
    assert "it has no domain of its own" in result.notes[0]


def test_what_stands_in_a_function_is_expanded_there() -> None:
    model = read(
        """<ir_version: 9, opset_import: ["" : 17, "own" : 1]>
        net (float[1,20,2,4] v, float[1,5,2,2,3,2] at, float[1,5,2,2,3] w)
            => (float[1,5,2,4] y)
            <int64[2,2] s = {4, 4, 2, 2}, int64[2] b = {0, 16}> {
            y = own.Attend(v, s, b, at, w)
        }
        <domain: "own", opset_import: ["" : 17, "me2e" : 1]>
        Attend (v, s, b, at, w) => (y) {
            y = me2e.MultiScaleDeformableAttention(v, s, b, at, w)
        }"""
    )

    apply(ExpandOperators(), model)

    given = {name: array for name, array in drawn().items() if name != "u"}
    (result,) = compute(model, given)
    np.testing.assert_allclose(result, reference("v", SIZES, STARTS), atol=1e-5)


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


def test_plugins_of_two_libraries_become_standard_operators() -> None:
    model = read(TWO)
    result = apply(ExpandOperators(), model)
    assert result.notes == ("expanded: 2 deformable-attention",)
    assert "GridSample" in ops(model)
    assert list(model.graph.opset_imports) == [""]


@pytest.mark.parametrize("dialects", [("tensorrt",), ("autoware", "derryhub")])
def test_a_graph_in_other_dialects_gives_the_same(dialects: tuple[str, ...]) -> None:
    model, other = read(RAW), read(RAW)
    for dialect in dialects:
        apply(TranslatePlugins(dialect), other)
    (node,) = (each for each in other.graph if each.domain)
    if dialects == ("tensorrt",):
        name = "trt.plugins", "MultiscaleDeformableAttnPlugin_TRT", ""
        assert node.op_identifier() == name
        assert node.attributes.get_string("plugin_version", "") == "1"
        kinds = [value.dtype for value in node.inputs[1:3] if value]
        assert kinds == [ir.DataType.INT32] * 2
    else:  # a round trip, to a library without a domain in the file
        assert node.domain == PLUGIN_DOMAIN
        assert node.metadata_props[ORIGINAL_DOMAIN] == ""
        back = with_own_domains(other).graph
        (written,) = (each for each in back if "TRT" in each.op_type)
        assert (written.domain, written.op_type) == ("", "MultiScaleDeformableAttnTRT")
    for each in (model, other):
        apply(ExpandOperators(), each)
    (want,), (got,) = (compute(each, fed(each, 3)) for each in (model, other))
    np.testing.assert_allclose(got, want, rtol=0, atol=1e-5)


OLD = """<ir_version: 9, opset_import: ["" : 13, "custom_op" : 1]>
net (float[1,2,4,4] x, float[1,2,3,3] at) => (float[1,2] y) {
    ["norm"] a = LeakyRelu<alpha = 0.5>(x)
    ["taken"] b = custom_op.GridSamplePlugin<mode = 0, padding_mode = 1>(a, at)
    ["most"] y = ReduceMax<axes = [2, 3], keepdims = 0>(b)
}"""


@pytest.mark.parametrize("current", [ExpandOperators(), AttachBodies()])
def test_the_opset_is_raised_for_a_body(current: Pass) -> None:
    model = read(OLD)
    want = Session(model).run(fed(model, 3))["y"]  # which does the same
    result = apply(current, model)
    assert result.notes[0] == "the graph is of opset 16 now: bodies need it"
    assert model.graph.opset_imports[""] == 16
    np.testing.assert_array_equal(compute(model, fed(model, 3))[0], want)


def test_a_graph_that_cannot_be_written_in_that_opset_is_refused() -> None:
    text = OLD.replace("(a, at)", "(c, at)").replace('["taken"]', "c = own.Part(a)\n")
    text = text.replace('"custom_op" : 1]', '"custom_op" : 1, "own" : 1]')
    part = "y = RoiAlign<output_height = 4, output_width = 4>(x, box, which)"
    text += f"""<domain: "own", opset_import: ["" : 13]> Part (x) => (y) {{
        box = Constant<value = float[1,4] {{0.0, 0.0, 4.0, 4.0}}>()
        which = Constant<value = int64[1] {{0}}>()
        {part}
    }}"""
    with pytest.raises(PreconditionError, match="needs opset 16 or later: RoiAlign"):
        ExpandOperators().run(read(text), NO_MODULES)


TURN = 'net (float[1,6,4,4] x) => (float[1,6,4,4] y) { ["turn"] y = InverseTRT(x) }'


def test_what_a_library_lacks_is_named() -> None:
    named = r"node turn: the dialect tensorrt has no inverse \(InverseTRT\)"
    with pytest.raises(PreconditionError, match=named):
        TranslatePlugins("tensorrt").run(read(OPSET + TURN), NO_MODULES)
    with pytest.raises(RecipeError, match="no dialect 'trt'; there are me2e, tensorrt"):
        TranslatePlugins("trt")


def test_plugins_nobody_knows_stay() -> None:
    model = read(OPSET + "net (float[2] x) => (float[2] y) { y = mmdeploy.What(x) }")
    assert ExpandOperators().run(model, NO_MODULES).changes == 0
    assert TranslatePlugins("tensorrt").run(model, NO_MODULES).changes == 0
