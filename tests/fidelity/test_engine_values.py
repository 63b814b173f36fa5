"""Values that an engine gave are held against those of its graph."""

from collections.abc import Mapping

import numpy as np
import numpy.typing as npt
import onnx_ir as ir
import pytest

from me2e_compress.fidelity.engine_run import EngineRun
from me2e_compress.fidelity.engine_values import first_difference_of_engine
from me2e_compress.runtime.session import Session
from tests.nets import conv_attention, image_frames, turn_softmax

Outputs = dict[str, npt.NDArray[np.generic]]


def outputs(model: ir.Model, names: tuple[str, ...]) -> list[Outputs]:
    copy = model.clone()
    made = {value.name: value for each in copy.graph for value in each.outputs}
    copy.graph.outputs.extend(made[name] for name in names)
    session, found = Session(copy, optimize=False), list[Outputs]()
    memory: Mapping[str, npt.NDArray[np.generic]] = {}
    for frame in image_frames():
        memory = memory or session.first_state({})
        found.append(session.run({**frame.arrays, **memory}))
        memory = {"memory": found[-1]["memory_out"]}
    return found


def engine(answers: list[Outputs]) -> EngineRun:
    return EngineRun(Session(conv_attention()), image_frames(), answers)


def test_values_of_an_engine_are_held_against_its_graph() -> None:
    wrong = conv_attention()
    turn_softmax(wrong)
    run = engine(outputs(wrong, ("r", "scores", "mixed")))

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
