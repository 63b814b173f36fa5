from collections.abc import Callable, Mapping
from pathlib import Path

import numpy as np
import onnx_ir as ir
import pytest

from me2e_compress.errors import EvaluationError, FramesError, GraphError, RecipeError
from me2e_compress.fidelity.first_difference import Source
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.runtime.frames import Frame
from me2e_compress.workflows.first_difference import first_difference
from tests.nets import conv_attention, image_frames, turn_softmax

Change = Callable[[ir.Model], object]


@pytest.fixture(scope="module")
def source() -> Source:
    return Source.of(conv_attention(), image_frames())


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


def absolute(model: ir.Model) -> None:
    model.graph.node("/backbone/Relu").op_type = "Abs"


FAULTS: Mapping[str, tuple[Change, str]] = {
    "weight": (lambda model: scale(model, "l", 1.001), "/head/Linear"),
    "bias": (lambda model: scale(model, "b", 0.0), "/backbone/Conv"),
    "axis": (turn_softmax, "/head/Softmax"),
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
        turn_softmax(model)
        rename(model)

    (place,) = source.first_difference(changed(change)).places

    assert place.operators == ("Softmax", "MatMul", "MatMul")
    assert place.value == "y"


def test_two_places_that_do_not_read_each_other_are_both_named(
    source: Source,
) -> None:
    def change(model: ir.Model) -> None:
        turn_softmax(model)
        scale(model, "half", 2.0)

    found = source.first_difference(changed(change))

    assert [each.nodes for each in found.places] == [("/head/Softmax",), ("/head/Mul",)]
    assert found.first is found.places[0]


def test_state_of_the_source_is_what_both_read(source: Source) -> None:
    found = source.first_difference(changed(lambda model: scale(model, "half", 2.0)))

    assert found.different == 1


def test_a_detour_through_float16_is_a_fault(source: Source) -> None:
    def change(model: ir.Model) -> None:
        relu = model.graph.node("/backbone/Relu")
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
    linear = model.graph.node("/head/Linear")
    nodes[0].replace_input_with(0, model.graph.node("/head/AV").outputs[0])
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
        model.graph.node("/head/Transpose").attributes["perm"] = ir.AttrInt64s(
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
