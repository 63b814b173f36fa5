"""The first module that differs is named, and rounding is not."""

from collections.abc import Callable, Mapping

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress.base.errors import EvaluationError, FramesError, GraphError
from me2e_compress.fidelity.engine_loss import (
    EngineRun,
    FirstDifference,
    find_first_difference,
    first_difference_of_engine,
)
from me2e_compress.graph import provenance
from me2e_compress.graph.provenance import Provenance
from me2e_compress.runtime.session import Session
from tests.support.nets import conv_attention, image_frames, parsed, turn_softmax

Change = Callable[[ir.Model], object]


def difference(candidate: ir.Model) -> FirstDifference:
    return find_first_difference(conv_attention(), candidate, image_frames())


def changed(change: Change) -> ir.Model:
    model = conv_attention()
    change(model)
    return model


def scale(model: ir.Model, name: str, by: float) -> None:
    value = model.graph.initializers[name]
    assert value.const_value is not None
    value.const_value = ir.tensor(value.const_value.numpy() * np.float32(by), name=name)


def absolute(model: ir.Model) -> None:
    model.graph.node("/backbone/Relu").op_type = "Abs"


def test_a_graph_does_not_differ_from_itself_and_rounding_is_no_difference() -> None:
    found = difference(conv_attention())
    assert (found.first, found.unknown) == (None, 0)
    assert {each.sqnr_db for each in found.values} == {np.inf}
    found = difference(changed(lambda model: scale(model, "l", 1 + 1e-6)))
    assert found.first is None
    assert min(each.sqnr_db for each in found.values) < np.inf


@pytest.mark.parametrize(
    ("change", "module"),
    [
        (lambda model: scale(model, "b", 0.0), "backbone"),
        (absolute, "backbone"),
        (turn_softmax, "head"),
        (lambda model: scale(model, "l", 1.001), "head"),
        (lambda model: scale(model, "half", 2.0), "head"),
    ],
)
def test_the_first_wrong_module_is_named(change: Change, module: str) -> None:
    first = difference(changed(change)).first

    assert first is not None
    assert first.module == module


def test_borders_without_a_namesake_are_counted() -> None:
    def rename(model: ir.Model) -> None:
        turn_softmax(model)
        model.graph.node("/backbone/Reshape").outputs[0].name = "other"

    found = difference(changed(rename))

    assert found.unknown == 2  # of either graph
    assert found.first is not None
    assert found.first.module == "head"


def int8(model: ir.Model) -> None:
    """Round the second product to a grid of a quarter of its range."""
    text = """
    q (float[1,64,8] mixed) => (float[1,64,8] coarse)
    <float step = {2.0}, int8 zero = {0}> {
        ["/head/Quantize"] grid = QuantizeLinear(mixed, step, zero)
        ["/head/Dequantize"] coarse = DequantizeLinear(grid, step, zero)
    }
    """
    part = parsed(text)
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


def test_a_graph_in_int8_is_judged_by_the_floor_of_outputs() -> None:
    found = difference(changed(int8))

    assert found.floor_db == 20
    assert found.first is not None
    assert found.first.module == "head"


OTHER = """
other (float[1,3,8,8] image, float[1,8,64] memory) => (float[1,3,8,8] z)
{ z = Exp(image) }
"""


@pytest.mark.parametrize(
    ("text", "error", "words"),
    [
        (OTHER, EvaluationError, "share no value at the border of a module"),
        (OTHER.replace("z", "y").replace("image", "picture"), FramesError, "picture"),
        (OTHER.replace("z", "y").replace("Exp", "Nobody"), GraphError, "Nobody"),
    ],
)
def test_graphs_that_cannot_be_compared_are_refused(
    text: str, error: type[Exception], words: str
) -> None:
    with pytest.raises(error, match=words):
        difference(parsed(text))
    with pytest.raises(EvaluationError, match="no frames to compare on"):
        find_first_difference(conv_attention(), conv_attention(), [])


Outputs = dict[str, npt.NDArray[np.generic]]


def engine(model: ir.Model, names: tuple[str, ...]) -> EngineRun:
    """What an engine of a graph dumps: its outputs, and these values inside."""
    made = {value.name: value for each in model.graph for value in each.outputs}
    model.graph.outputs.extend(made[name] for name in names)
    session, found = Session(model, optimize=False), list[Outputs]()
    memory: Mapping[str, npt.NDArray[np.generic]] = {}
    for frame in image_frames():
        memory = memory or session.first_state({})
        found.append(session.run({**frame.arrays, **memory}))
        memory = {"memory": found[-1]["memory_out"]}
    return EngineRun(Session(conv_attention()), image_frames(), found)


def test_what_an_engine_dumped_is_compared_with_its_graph() -> None:
    names = "r", "scores", "mixed"

    wrong = first_difference_of_engine(
        conv_attention(), engine(changed(turn_softmax), names)
    )
    right = first_difference_of_engine(
        conv_attention(), engine(conv_attention(), names)
    )

    assert wrong.first is not None
    assert wrong.first.value == "mixed"
    assert (right.first, len(right.values)) == (None, 5)
