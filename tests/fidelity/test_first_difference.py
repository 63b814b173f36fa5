from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from benchmarks.wrong_nodes import seed_fault
from me2e_compress import graph
from me2e_compress.errors import (
    EvaluationError,
    FramesError,
    GraphError,
    Me2eError,
    RecipeError,
)
from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.engine_values import first_difference_of_engine
from me2e_compress.fidelity.first_difference import FirstDifference, Source
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.manager import recipe
from me2e_compress.manager.pass_manager import PassManager
from me2e_compress.runtime.frames import Frame
from me2e_compress.runtime.session import Session
from me2e_compress.workflows.first_difference import first_difference
from tests.fuzz.exact.drawing import draw
from tests.fuzz.exact.judging import Case
from tests.fuzz.exact.running import drawn_inputs
from tests.nets import conv_attention, image

FRAMES = [Frame(at, at == 0, dict(image(at))) for at in range(2)]

Change = Callable[[ir.Model], object]
Outputs = dict[str, npt.NDArray[np.generic]]


@pytest.fixture(scope="module")
def source() -> Source:
    return Source.of(conv_attention(), FRAMES)


def node(model: ir.Model, name: str) -> ir.Node:
    return next(each for each in model.graph if each.name == name)


def changed(change: Change) -> ir.Model:
    model = conv_attention()
    change(model)
    return model


def scale(model: ir.Model, name: str, by: float) -> None:
    value = model.graph.initializers[name]
    assert value.const_value is not None
    value.const_value = ir.tensor(value.const_value.numpy() * np.float32(by), name=name)


def rename(model: ir.Model) -> None:
    for at, each in enumerate(model.graph):
        each.name = f"n{at}"
        for value in each.outputs:
            if not value.is_graph_output():
                value.name = f"v{at}"


def test_a_graph_does_not_differ_from_itself(source: Source) -> None:
    found = source.first_difference(conv_attention())

    assert (found.places, found.different, found.unknown) == ((), 0, 0)
    assert found.compared == 10


def test_a_renamed_graph_does_not_differ(source: Source) -> None:
    found = source.first_difference(changed(rename))

    assert (found.places, found.different, found.unknown) == ((), 0, 0)


def axis(model: ir.Model) -> None:
    node(model, "/head/Softmax").attributes["axis"] = ir.AttrInt64("axis", 1)


def absolute(model: ir.Model) -> None:
    node(model, "/backbone/Relu").op_type = "Abs"


FAULTS: Mapping[str, tuple[Change, str]] = {
    "weight": (lambda model: scale(model, "l", 1.001), "/head/Linear"),
    "bias": (lambda model: scale(model, "b", 0.0), "/backbone/Conv"),
    "axis": (axis, "/head/Softmax"),
    "operator": (absolute, "/backbone/Relu"),
    "state": (lambda model: scale(model, "half", 2.0), "/head/Mul"),
}


@pytest.mark.parametrize("name", FAULTS)
def test_the_wrong_node_is_named_with_its_module(source: Source, name: str) -> None:
    change, wrong = FAULTS[name]

    (place,) = source.first_difference(changed(change)).places

    assert place.nodes == place.origins == (wrong,)
    assert place.module == wrong.split("/")[1]
    assert place.reaches
    assert place.own_db is not None
    assert place.own_db < 100


def test_a_fault_in_a_renamed_graph_lies_in_the_stretch_to_a_known_value(
    source: Source,
) -> None:
    def change(model: ir.Model) -> None:
        axis(model)
        rename(model)

    (place,) = source.first_difference(changed(change)).places

    assert place.operators == ("Softmax", "MatMul", "MatMul")
    assert place.value == "y"


def test_two_places_that_do_not_read_each_other_are_both_named(
    source: Source,
) -> None:
    def change(model: ir.Model) -> None:
        axis(model)
        scale(model, "half", 2.0)

    found = source.first_difference(changed(change))

    assert [each.nodes for each in found.places] == [("/head/Softmax",), ("/head/Mul",)]
    assert found.first is found.places[0]


def test_state_of_the_source_is_what_both_read(source: Source) -> None:
    found = source.first_difference(changed(lambda model: scale(model, "half", 2.0)))

    assert found.different == 1


HIDDEN = """
<ir_version: 9, opset_import: ["" : 17]>
hidden (float[1,8] x) => (float[1,8] y) <float one = {1.0}, float zero = {0.0}> {
    ["a"] low = %s(x)
    ["b"] shifted = Add(low, one)
    ["c"] gone = Mul(shifted, zero)
    ["d"] y = Add(x, gone)
}
"""


def test_what_never_reaches_an_output_is_told_apart() -> None:
    frames = [Frame(0, True, {"x": np.ones((1, 8), np.float32)})]
    source = Source.of(ir.from_onnx_text(HIDDEN % "Sigmoid"), frames)

    found = source.first_difference(ir.from_onnx_text(HIDDEN % "Tanh"))

    assert found.first is None
    assert not found.outputs_differ
    assert next(each.nodes for each in found.places) == ("a",)


def test_what_reaches_an_output_comes_first() -> None:
    frames = [Frame(0, True, {"x": np.ones((1, 8), np.float32)})]
    source = Source.of(ir.from_onnx_text(HIDDEN % "Sigmoid"), frames)
    text = (HIDDEN % "Tanh").replace("Add(x, gone)", "Div(x, gone)")

    found = source.first_difference(ir.from_onnx_text(text))

    assert [each.nodes for each in found.places] == [("d",)]


def test_a_detour_through_float16_is_a_fault(source: Source) -> None:
    def change(model: ir.Model) -> None:
        relu = node(model, "/backbone/Relu")
        narrow = ir.node("Cast", [relu.inputs[0]], {"to": 10}, name="narrow")
        wide = ir.node("Cast", narrow.outputs, {"to": 1}, name="wide")
        model.graph.insert_before(relu, [narrow, wide])
        relu.replace_input_with(0, wide.outputs[0])
        for each in (narrow, wide):
            each.outputs[0].name = f"{each.name}_value"

    found = source.first_difference(changed(change))

    assert not found.lossy
    assert [each.nodes for each in found.places] == [
        ("narrow", "wide", "/backbone/Relu")
    ]


GROWN = """
<ir_version: 9, opset_import: ["" : 17]>
grown (float[1,64] x) => (float[1,64] y)
<float nearly_one = {%s}, float big = {1e6}> {
    ["a"] same = Mul(x, nearly_one)
    ["b"] large = Mul(same, big)
    ["c"] wave = Sin(large)
    ["d"] y = Exp(wave)
}
"""


def test_rounding_that_grew_is_no_fault() -> None:
    x = np.random.default_rng(0).standard_normal((1, 64)).astype(np.float32)
    frames = [Frame(0, True, {"x": x})]
    source = Source.of(ir.from_onnx_text(GROWN % "1.0"), frames)

    found = source.first_difference(ir.from_onnx_text(GROWN % "1.000001"))

    assert found.outputs_differ
    assert found.places == ()
    assert found.inherited == 2


MISSING = """
<ir_version: 9, opset_import: ["" : 17]>
missing (float[1,8] x) => (float[1,8] y) {
    ["tanh"] t = Tanh(x)
    ["relu"] r = %s(t)
    ["exp"] y = Exp(r)
}
"""


def test_a_lost_node_is_found_although_its_value_equals_another() -> None:
    x = np.random.default_rng(0).standard_normal((1, 8)).astype(np.float32)
    source = Source.of(ir.from_onnx_text(MISSING % "Relu"), [Frame(0, True, {"x": x})])

    (place,) = source.first_difference(ir.from_onnx_text(MISSING % "Identity")).places

    assert place.nodes == ("relu",)


FACTOR = """
<ir_version: 9, opset_import: ["" : 17]>
factor (float[4,8] x) => (float[4,8] y)
<float[8] w = {%s}, int64[3] form = {2, 2, 8}, float[8] halves = {%s}> {
    ["first"] a = Mul(x, w)
    ["bias"] b = Relu(a)
    ["shape"] c = Reshape(b, form)
    %s
    ["last"] e = %s(d)
    ["sum"] y = ReduceSum<keepdims=0>(e)
}
"""


def factor(*, moved: bool, last: str = "Exp") -> ir.Model:
    """Multiply by a factor a column, behind a Reshape, or in the weights before it."""
    halves = [0.5, 0.25] * 4
    weights = [(each + 1.0) * (by if moved else 1.0) for each, by in enumerate(halves)]
    scale = '["scale"] d = %s(c, halves)' % ("Add" if moved else "Mul")
    numbers = [", ".join(map(str, each)) for each in (weights, halves)]
    model = ir.from_onnx_text(FACTOR % (*numbers, scale, last))
    for each in model.graph:
        name = str(each.name)
        origins = (name, "scale") if moved and name in ("first", "bias") else (name,)
        provenance.stamp(each, Provenance("head", origins))
    if moved:  # the factor is in the weights now
        scaled = node(model, "scale")
        node(model, "last").replace_input_with(0, scaled.inputs[0])
        model.graph.remove(scaled, safe=True)
    return model


@pytest.mark.parametrize("last", ["Exp", "Sigmoid"])
def test_a_factor_that_a_pass_moved_is_no_fault(last: str) -> None:
    x = np.random.default_rng(0).standard_normal((4, 8)).astype(np.float32)
    source = Source.of(factor(moved=False), [Frame(0, True, {"x": x})])

    found = source.first_difference(factor(moved=True, last=last))

    named = [each.nodes for each in found.places]
    assert named == ([] if last == "Exp" else [("last",)])


@pytest.mark.parametrize("exact", [False, True])
@pytest.mark.parametrize("first", range(0, 24, 6))
def test_faults_in_drawn_graphs_are_found(first: int, exact: bool) -> None:
    for seed in range(first, first + 6):
        case = Case(draw(seed), seed)
        feeds = [
            drawn_inputs(case.answers.runner, seed + at, case.sizes[0]) for at in (0, 1)
        ]
        candidate = case.imported.clone()
        if exact:
            passes = recipe.parse("fold-constants,eliminate-redundant,fuse-basic")
            manager = PassManager(passes, verify_frames=0)
            candidate = manager.run(candidate, case.context).model
        try:
            source = Source.of(
                case.imported, [Frame(at, True, each) for at, each in enumerate(feeds)]
            )
            assert source.first_difference(candidate).first is None, seed
            for value in candidate.graph.inputs:
                value.shape = ir.Shape(feeds[0][str(value.name)].shape)
            graph.infer_shapes(candidate)
            fault = seed_fault(candidate, seed)
            found = source.first_difference(candidate)
        except (Me2eError, ValueError):
            continue  # nothing is computed, or no fault fits
        assert _names(found, fault.nodes), (seed, fault)


def _names(found: FirstDifference, nodes: tuple[str, ...]) -> bool:
    first = found.first or next(iter(found.places), None)
    return not found.different or (
        first is not None and bool(set(nodes) & set(first.nodes))
    )


def int8(model: ir.Model) -> ir.Model:
    """Round the second product to a grid of a quarter of its range."""
    text = """
    <ir_version: 9, opset_import: ["" : 17]>
    q (float[1,64,8] mixed) => (float[1,64,8] coarse)
    <float step = {2.0}, int8 zero = {0}> {
        ["/head/Quantize"] grid = QuantizeLinear(mixed, step, zero)
        ["/head/Dequantize"] coarse = DequantizeLinear(grid, step, zero)
    }
    """
    part = ir.from_onnx_text(text)
    nodes = list(part.graph)
    constants = list(part.graph.initializers.values())
    part.graph.outputs.clear()
    part.graph.remove(nodes)
    part.graph.initializers.clear()
    for each in constants:
        model.graph.register_initializer(each)
    mixed, linear = node(model, "/head/AV").outputs[0], node(model, "/head/Linear")
    nodes[0].replace_input_with(0, mixed)
    model.graph.insert_before(linear, nodes)
    linear.replace_input_with(0, nodes[-1].outputs[0])
    for made in nodes:
        provenance.stamp(made, Provenance("head", (str(made.name),)))
    return model


def test_a_lossy_graph_is_judged_by_decibels_and_its_modules_are_told(
    source: Source,
) -> None:
    found = source.first_difference(int8(conv_attention()))

    (place,) = found.places
    assert found.lossy
    assert found.floor_db == 20
    assert set(place.nodes) >= {"/head/Quantize", "/head/Dequantize"}
    backbone, head = found.modules
    assert backbone.after_db == np.inf
    assert head.after_db is not None
    assert head.after_db < 20


def outputs(model: ir.Model, names: tuple[str, ...]) -> list[Outputs]:
    copy = model.clone()
    made = {value.name: value for each in copy.graph for value in each.outputs}
    copy.graph.outputs.extend(made[name] for name in names)
    session, found = Session(copy, optimize=False), list[Outputs]()
    memory: Mapping[str, npt.NDArray[np.generic]] = {}
    for frame in FRAMES:
        memory = memory or session.first_state({})
        found.append(session.run({**frame.arrays, **memory}))
        memory = {"memory": found[-1]["memory_out"]}
    return found


def engine(answers: list[Outputs]) -> EngineRun:
    return EngineRun(Session(conv_attention()), FRAMES, answers)


def test_values_of_an_engine_are_held_against_its_graph() -> None:
    run = engine(outputs(changed(axis), ("r", "scores", "mixed")))

    found = first_difference_of_engine(conv_attention(), run)

    (place,) = found.places
    assert place.value == "mixed"
    assert place.nodes[-2:] == ("/head/Softmax", "/head/AV")
    assert place.own_db is not None
    assert place.own_db < 20


@pytest.mark.parametrize("state", [True, False])
def test_values_of_a_right_engine_do_not_differ(state: bool) -> None:
    answers = outputs(conv_attention(), ("r", "mixed"))
    kept = [{k: v for k, v in e.items() if state or k != "memory_out"} for e in answers]

    found = first_difference_of_engine(conv_attention(), engine(kept))

    assert (found.places, found.different) == ((), 0)
    assert found.compared == 3 + state


OTHER = """
<ir_version: 9, opset_import: ["" : 17]>
other (float[1,3,8,8] image, float[1,8,64] memory) => (float[1,3,8,8] z)
{ z = Exp(image) }
"""


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (OTHER, EvaluationError, "share no value, by name or by content"),
        (OTHER.replace("image", "picture"), FramesError, "input picture is missing"),
        (OTHER.replace("Exp(image)", "Nobody(image)"), GraphError, "Nobody"),
    ],
)
def test_graphs_that_cannot_be_held_together_are_refused(
    source: Source, text: str, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        source.first_difference(ir.from_onnx_text(text))


def test_no_frame_is_refused() -> None:
    with pytest.raises(EvaluationError, match="no frames to compare on"):
        Source.of(conv_attention(), [])


def test_a_value_of_another_shape_differs(source: Source) -> None:
    def change(model: ir.Model) -> None:
        node(model, "/head/Transpose").attributes["perm"] = ir.AttrInt64s(
            "perm", [2, 1, 0]
        )

    with pytest.raises(GraphError):  # onnxruntime itself refuses the product behind it
        source.first_difference(changed(change))


EMPTY = """
<ir_version: 9, opset_import: ["" : 17]>
empty (float[1,8] x) => (float[1,8] y, int64[2,n] places) {
    ["relu"] r = Relu(x)
    ["places"] places = NonZero(r)
    ["exp"] y = %s(r)
}
"""


def test_tensors_without_elements_are_passed_by() -> None:
    frames = [Frame(0, True, {"x": -np.ones((1, 8), np.float32)})]
    source = Source.of(ir.from_onnx_text(EMPTY % "Exp"), frames)

    found = source.first_difference(ir.from_onnx_text(EMPTY % "Sigmoid"))

    assert [each.nodes for each in found.places] == [("exp",)]


def test_what_changes_its_shape_from_frame_to_frame_is_held_too() -> None:
    frames = [
        Frame(0, True, {"x": np.ones((1, 8), np.float32)}),
        Frame(1, True, {"x": np.arange(8, dtype=np.float32)[None]}),
    ]
    source = Source.of(ir.from_onnx_text(EMPTY % "Exp"), frames)

    found = source.first_difference(
        ir.from_onnx_text((EMPTY % "Exp").replace("NonZero(r)", "NonZero(x)"))
    )

    assert (found.compared, found.different) == (3, 0)


def test_python_refuses_no_frames(tmp_path: Path) -> None:
    with pytest.raises(RecipeError, match="most_frames is 0"):
        first_difference("a.onnx", "b.onnx", tmp_path, most_frames=0)
