import numpy as np
import onnx_ir as ir
import onnxruntime

from me2e_compress.graph import static_shape
from me2e_compress.manager import PassManager, recipe
from me2e_compress.operators.deformable_attention import DeformableAttention
from me2e_compress.operators.multi_head_attention import FusedMultiHeadAttention
from me2e_compress.passes.attach_bodies import AttachBodies
from me2e_compress.passes.fused_nodes import ExpandOperators
from tests.passes.decomposed import Sizes, decomposed
from tests.passes.small import NO_MODULES, apply, compute, ops, read

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


def test_nodes_of_the_same_sizes_share_a_body_that_any_runtime_runs() -> None:
    model = read(ALIKE)

    result = apply(AttachBodies(), model)

    assert result.notes == ("a body for 2 MultiScaleDeformableAttention",)
    (body,) = model.functions.values()
    assert "GridSample" in {node.op_type for node in body}
    np.testing.assert_allclose(
        in_plain_onnxruntime(model), 2 * reference("v", SIZES, STARTS), atol=1e-5
    )


def test_nodes_of_other_sizes_share_one_that_reads_them_when_it_runs() -> None:
    model = read(OF_OTHER_SIZES)

    apply(AttachBodies(), model)

    expected = reference("v", SIZES, STARTS) + reference(
        "u", np.array([[1, 2], [1, 2]]), np.array([0, 2])
    )
    np.testing.assert_allclose(in_plain_onnxruntime(model), expected, atol=1e-5)


def test_the_recipe_that_fuses_writes_what_plain_onnxruntime_runs() -> None:
    model = decomposed(Sizes())
    draws = np.random.default_rng(6)
    fed = {
        str(port.name): draws.normal(size=static_shape(port)).astype(np.float32)
        for port in model.graph.inputs
    }

    made = PassManager(recipe.load("fused")).run(model.clone(), NO_MODULES).model

    assert "MultiScaleDeformableAttention" in ops(made)
    for one, other in zip(compute(made, fed), compute(model, fed), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-4)


def test_a_second_time_there_is_nothing_to_do() -> None:
    model = read(ALIKE)
    apply(AttachBodies(), model)
    assert apply(AttachBodies(), model).changes == 0


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


def test_a_second_time_bodies_of_two_sets_of_attributes_stay() -> None:
    model = read(OF_TWO_COUNTS_OF_HEADS)
    apply(AttachBodies(), model)
    assert apply(AttachBodies(), model).changes == 0


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
    (found,) = compute(model, given)
    np.testing.assert_allclose(found, reference("v", SIZES, STARTS), atol=1e-5)
