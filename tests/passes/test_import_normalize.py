"""What an import names, stamps and moves; float64 becomes float32 inside."""

import numpy as np
import onnx
import onnx_ir as ir
import pytest

from me2e_compress import graph
from me2e_compress.base.errors import ModuleMapError
from me2e_compress.graph import provenance
from me2e_compress.graph.modules.module_map import ModuleMap
from me2e_compress.graph.validity import ORIGINAL_DOMAIN, PLUGIN_DOMAIN
from me2e_compress.passes import Context
from me2e_compress.passes.import_normalize import (
    ImportNormalize,
    needs_import,
    with_own_domains,
)
from tests.passes.small import EVERYTHING, compute, normalise, settled, unstamped
from tests.support.plugins import exported


@pytest.mark.parametrize(
    ("given", "made"),
    [
        (("", "/part/Relu", "/part/Relu"), ["Relu_0", "/part/Relu", "/part/Relu_0"]),
        (("", "Relu_0", "/part/Neg"), ["Relu_1", "Relu_0", "/part/Neg"]),
    ],
    ids=["one name twice", "the name of a later node"],
)
def test_unnamed_and_doubly_named_nodes_get_names_of_their_own(
    given: tuple[str, ...], made: list[str]
) -> None:
    model = unstamped("g (float[2] x) => (float[2] y) { a=Relu(x) b=Relu(a) y=Neg(b) }")
    for node, name in zip(model.graph, given, strict=True):
        node.name = name
    ImportNormalize().run(model, Context(EVERYTHING))
    assert [n.name for n in model.graph] == made
    assert settled(model)


def test_every_node_is_told_its_module_and_origin() -> None:
    model = unstamped(
        "g (bool c, float[2] x) => (float[2] y) {"
        " y = If (c) <then_branch = t () => (float[2] a) { a = Relu(x) },"
        " else_branch = e () => (float[2] b) { b = Neg(x) }> }"
    )
    normalise(model)
    assert provenance.missing(model) == []
    pasts = [provenance.read(node) for node in model.graph.all_nodes()]
    assert pasts == [
        provenance.Provenance("all", (f"/part/{name}",)) for name in ("y", "a", "b")
    ]
    assert settled(model)


def test_a_past_that_is_known_stays() -> None:
    model = unstamped("g (float[2] x) => (float[2] y) { a = Relu(x) y = Neg(a) }")
    known = provenance.Provenance("planner", ("before",), ("fuse-basic",))
    provenance.stamp(model.graph[0], known)
    normalise(model)
    assert provenance.read(model.graph[0]) == known


@pytest.mark.parametrize(
    "plugin", ["MultiScaleDeformableAttnTRT", "RotateTRT2", "InverseTRT", "MSDAPlugin"]
)
def test_plugins_of_the_default_domain_move_to_a_private_one(plugin: str) -> None:
    model = unstamped(
        "g (float[2] x) => (float[2] y) { a = Relu(x) b = "
        + plugin
        + " <mode: int = 1> (a) y = Neg(b) }"
    )
    normalise(model)
    moved = model.graph[1]
    assert (moved.domain, moved.op_type) == (PLUGIN_DOMAIN, plugin)
    assert moved.metadata_props[ORIGINAL_DOMAIN] == ""
    assert moved.attributes["mode"].as_int() == 1
    assert model.opset_imports[PLUGIN_DOMAIN] == 1
    onnx.checker.check_model(ir.to_proto(model))
    assert settled(model)


def test_plugins_go_out_under_the_domain_that_they_came_with() -> None:
    model = exported(shapes=True)
    normalise(model)
    assert not needs_import(model)
    written = with_own_domains(model)
    assert needs_import(written)
    assert [node.domain for node in written.graph] == [""] * len(written.graph)
    assert PLUGIN_DOMAIN not in written.opset_imports
    assert with_own_domains(written) is written


def test_a_plugin_in_a_branch_and_one_in_a_function_move_too() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 7, opset_import: ["": 17, "f": 1]>'
        "g (bool c, float[2] x) => (float[2] y) {"
        " z = f.Twice(x)"
        " y = If (c) <then_branch = t () => (float[2] a) { a = InverseTRT(z) },"
        " else_branch = e () => (float[2] b) { b = Neg(z) }> }"
        '<domain: "f", opset_import: ["": 17]>'
        "Twice (i) => (o) { h = RotateTRT(i) o = Add(h, h) }"
    )
    normalise(model)
    function = model.functions["f", "Twice", ""]
    moved = [
        node.op_type
        for body in (model.graph, function.graph)
        for node in body.all_nodes()
        if node.domain == PLUGIN_DOMAIN
    ]
    assert moved == ["InverseTRT", "RotateTRT"]
    assert function.opset_imports[PLUGIN_DOMAIN] == 1
    assert model.ir_version == 8
    onnx.checker.check_model(ir.to_proto(model))
    assert settled(model)


def test_custom_operators_of_their_own_domain_are_carried_through() -> None:
    model = unstamped(
        "g (float[2] x) => (float[2] y) { a = custom_op.SelectAndPadPlugin(x)"
        " y = Neg(a) }"
    )
    normalise(model)
    assert (model.graph[0].domain, model.graph[0].op_type) == (
        "custom_op",
        "SelectAndPadPlugin",
    )
    assert ORIGINAL_DOMAIN not in model.graph[0].metadata_props
    assert model.opset_imports["custom_op"] == 1


def test_constants_become_initializers_in_branches_too() -> None:
    model = unstamped(
        "g (bool c, float[2] x) => (float[2] y) {"
        " k = Constant <value_float = 2.0> () e = Constant <value = float[0] {}> ()"
        " w = Concat <axis = 0> (x, e) z = Mul (w, k)"
        " y = If (c) <"
        "then_branch = t () => (float[2] a) {"
        " one = Constant <value_floats = [1.0, 1.0]> () a = Add(z, one) },"
        " else_branch = e () => (float[2] b) { b = Neg(z) }> }"
    )
    normalise(model)
    left = ["Concat", "Mul", "If", "Add", "Neg"]
    assert [n.op_type for n in model.graph.all_nodes()] == left
    assert list(model.graph.initializers) == ["k", "e"]
    onnx.checker.check_model(ir.to_proto(model))
    assert settled(model)


def test_text_constants_keep_any_letter_and_outputs_stay_nodes() -> None:
    model = unstamped(
        "g (float[2] x) => (string[2] y, float z) {"
        ' k = Constant <value_strings = ["straße", "道"]> () y = Identity(k)'
        " z = Constant <value_float = 2.0> () }"
    )
    normalise(model)
    stored = onnx.numpy_helper.to_array(ir.to_proto(model).graph.initializer[0])
    assert stored.tolist() == ["straße", "道"]
    assert [node.op_type for node in model.graph] == ["Identity", "Constant"]
    assert settled(model)


def test_a_map_of_another_stack_is_refused() -> None:
    model = unstamped("g (float[2] x) => (float[2] y) { y = Relu(x) }")
    with pytest.raises(ModuleMapError, match="map vad: none of its patterns"):
        ImportNormalize().run(model, Context(ModuleMap.load("vad")))


def double_grid() -> ir.Model:
    return unstamped(
        "g (float[1, 1, 4, 4] x, float[1, 3, 3, 2] p) => (float[1, 1, 3, 3] y) {"
        " wide = Cast <to: int = 11> (p)"
        " half = Constant <value: tensor = double {0.5}> ()"
        " grid = Mul (wide, half)"
        " y = GridSample (x, grid) }"
    )


def test_a_double_grid_that_onnxruntime_refuses_runs_afterwards() -> None:
    model = double_grid()
    rng = np.random.default_rng(0)
    x = rng.standard_normal((1, 1, 4, 4), np.float32)
    p = rng.uniform(-1, 1, (1, 3, 3, 2)).astype(np.float32)
    with pytest.raises(Exception, match="GridSample"):
        compute(model, {"x": x, "p": p})
    normalise(model)
    reference = unstamped(
        "g (float[1, 1, 4, 4] x, float[1, 3, 3, 2] g) => (float[1, 1, 3, 3] y) {"
        " y = GridSample (x, g) }"
    )
    (result,) = compute(model, {"x": x, "p": p})
    (wanted,) = compute(reference, {"x": x, "g": p / np.float32(2)})
    np.testing.assert_allclose(result, wanted, rtol=0, atol=1e-6)
    assert settled(model)


def test_no_double_is_left_in_types_weights_branches_and_functions() -> None:
    model = ir.from_onnx_text(
        '<ir_version: 8, opset_import: ["": 17, "f": 1]>'
        "g (bool c, float[2] x) => (float[2] y)"
        " <double[2] w = {1.0, 2.0}, double[2] wide, double[2] z> {"
        " wide = Cast <to: int = 11> (x)"
        " z = If (c) <then_branch = t () => (double[2] a) <double k = {3.0}> {"
        " a = Mul(wide, k) },"
        " else_branch = e () => (double[2] b) { b = Add(wide, w) }>"
        " v = f.Widen(z)  y = Cast <to: int = 1> (v) }"
        '<domain: "f", opset_import: ["": 17]>'
        "Widen (i) => (o) { k = Constant <value: tensor = double {2.0}> ()"
        " w = Cast <to: int = 11> (i) o = Mul(w, k) }"
    )
    normalise(model)
    assert "DOUBLE" not in str(ir.to_proto(model))
    assert _doubles_of(ir.to_proto(model)) == 0
    x = np.array([1, 2], np.float32)
    for chosen, wanted in ((True, [6, 12]), (False, [4, 8])):
        (y,) = compute(model, {"c": np.array(chosen), "x": x})
        np.testing.assert_array_equal(y, wanted)
    assert settled(model)


def _doubles_of(message: onnx.ModelProto) -> int:
    text = str(message)
    return text.count("elem_type: 11\n") + text.count("data_type: 11\n")


def test_resize_scales_computed_in_double_become_float32() -> None:
    model = unstamped(
        "g (float[1, 1, 2, 2] x) => (float[1, 1, 4, 4] y)"
        " <double[4] factors = {1.0, 1.0, 2.0, 2.0}> {"
        " s = Identity (factors)"
        ' y = Resize <mode: string = "nearest"> (x, , s) }'
    )
    normalise(model)
    x = np.arange(4, dtype=np.float32).reshape(1, 1, 2, 2)
    (result,) = compute(model, {"x": x})
    np.testing.assert_array_equal(result, x.repeat(2, axis=2).repeat(2, axis=3))


def test_numbers_beyond_float32_stay_finite_and_infinities_stay_infinite() -> None:
    model = unstamped(
        "g (float[3] x) => (float[3] y)"
        " <double[3] m = {-1.7976931348623157e308, 1.0, 2.0}> {"
        " w = Cast <to: int = 11> (x) s = Add(w, m) y = Cast <to: int = 1> (s) }"
    )
    lowest = np.array([-np.finfo(np.float64).max, np.inf, 2.0])
    model.graph.initializers["m"].const_value = ir.tensor(lowest, name="m")
    normalise(model)
    kept = graph.array_of(model.graph.initializers["m"])
    assert kept is not None
    np.testing.assert_array_equal(
        kept, np.array([np.finfo(np.float32).min, np.inf, 2.0], np.float32)
    )


@pytest.mark.parametrize(
    ("text", "culprit"),
    [
        ("g (double[2] x) => (float[2] y) { y = Cast<to: int = 1>(x) }", "input x"),
        ("g (float[2] x) => (double[2] y) { y = Cast<to: int = 11>(x) }", "output y"),
        (
            "g (float[2] x) => (float[2] y) <double[2] w = {1.0, 2.0}>"
            " { y = custom_op.Warp(x, w) }",
            "w of the custom operator Warp",
        ),
    ],
)
def test_doubles_that_the_outside_wants_stay(text: str, culprit: str) -> None:
    model = unstamped(text)
    result = normalise(model)
    assert _doubles_of(ir.to_proto(model)) > 0
    assert result.notes == (f"float64 stays: {culprit} is double",)
    assert settled(model)


@pytest.mark.parametrize(
    ("sides", "axis", "stays"),
    [("3,1,1", 0, False), ("1,3,1,1", 0, False), ("3,1", 1, True), ("2,2", 1, True)],
)
def test_scales_by_channel_become_vectors(sides: str, axis: int, stays: bool) -> None:
    text = f"""
        <ir_version: 10, opset_import: ["" : 21]>
        g () => (float[3,4] y)
            <int8[3,4] w = {{1,2,3,4,5,6,7,8,9,10,11,12}},
             float[{sides}] s = {{1,2,3{",4" * (sides == "2,2")}}}>
        {{ y = DequantizeLinear<axis={axis}>(w, s) }}
    """
    model = ir.from_onnx_text(text)

    normalise(model)

    scale = model.graph[0].inputs[1]
    assert scale is not None
    assert scale.shape is not None
    assert (len(scale.shape) > 1) is stays
